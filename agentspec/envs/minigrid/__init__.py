"""MiniGrid and BabyAI: grids seen as egocentric text (`view`), played by a scripted expert too (`expert`, `search`)."""

from agentspec.envs.registration import register_env

register_env(
    "agentspec/MiniGrid-v0",
    "agentspec.envs.minigrid.env:MiniGridEnv",
    name="minigrid",
    summary="MiniGrid and BabyAI grids: egocentric text, success within 100 steps, the paper's ten tasks",
)
