"""ALFRED: household tasks of seven types from a natural instruction, in 200 steps (Shridhar et al., 2020)."""

from agentspec.envs.registration import register_env

register_env(
    "agentspec/Alfred-v0",
    "agentspec.envs.alfred.env:AlfredEnv",
    name="alfred",
    summary="ALFRED household tasks: find, carry, heat, cool, clean, slice, within 200 steps",
)
