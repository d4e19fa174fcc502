"""A stand-in for the simulator's executable: the offline world behind ai2thor's own protocols.

ai2thor's Controller starts a program and talks to it through pipes (FIFO, versions since 2.7) or HTTP (WSGI, the only
way of 2.1.0, in which the program is the client). This program speaks both and answers from `OfflineThor`, so that the
real Controller's code runs where no build of the simulator does: `python -m agentspec.envs.thor.standin`.
"""
