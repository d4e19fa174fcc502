"""Our worlds and scaffolds in other people's frameworks: thin adapters, one file each.

`trl` makes tools for TRL's `environment_factory`, `openenv` a server that any OpenEnv client can play on, `verifiers` a
taskset and a harness. Each needs the framework it is named after, and nothing else in this package needs them.
"""
