"""The name under which recipes import the writer of a run's records."""

from agentspec.records.log import RunLog

__all__ = ["RunLog"]
