"""The name under which recipes import what the files of a run are called."""

from agentspec.records.folder import METRICS

__all__ = ["METRICS"]
