"""RoboTHOR object navigation: find an object of a class and stop where it is in view (Deitke et al., 2020)."""

from agentspec.envs.registration import register_env

register_env(
    "agentspec/RoboThor-v0",
    "agentspec.envs.robothor.env:RoboThorEnv",
    name="robothor",
    summary="RoboTHOR object navigation: find an object of a class in an apartment and stop, within 200 steps",
)
