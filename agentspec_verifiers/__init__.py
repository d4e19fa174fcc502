"""The plugin that verifiers finds by name: `vf-eval agentspec-verifiers` (see `agentspec.interop.verifiers`)."""

from agentspec.interop.verifiers import ScaffoldHarness, WorldEnv, WorldTaskset

__all__ = ["ScaffoldHarness", "WorldEnv", "WorldTaskset"]
