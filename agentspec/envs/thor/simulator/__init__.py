"""The real simulator as a player: ai2thor's Controller behind the contract of `agentspec.envs.thor.protocol`."""
