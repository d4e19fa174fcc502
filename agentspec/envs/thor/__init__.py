"""One household contract, several players: actions and metadata with ai2thor's field names.

A player (`agentspec.envs.thor.protocol.Thor`) takes an action such as `{"action": "MoveAhead"}` and answers with an
`Event`: metadata and a picture. Task logic, metrics and texts (`agentspec.envs.alfred`, `agentspec.envs.robothor`) read
nothing but events, so that they are the same for every player. The default player is `engine.OfflineThor`, a world of
boxes on a grid that needs neither a game engine nor a network.
"""
