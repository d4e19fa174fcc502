"""Settings of the whole suite: no test depends on how fast this machine is just now."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("agentspec", deadline=None)
settings.load_profile("agentspec")
