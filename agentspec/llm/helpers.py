"""Helper models: modules that are answered by another model than the policy (`roles` in a spec).

A role is a backend: `{model: NAME}` (a local model), `{model: NAME, adapter: FOLDER}` (with an adapter on it) or
`{endpoint: URL, model: NAME}` (an OpenAI-compatible server); all other keys are those of the backend. A helper is
loaded once per process, when it is first asked. Its calls are metered, budgeted and recorded like the policy's, and
never trained: they are not the policy's choices.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from agentspec.llm.base import LLM
from agentspec.registry import SpecError

_LOADED: dict[str, LLM] = {}


def check_helper(where: str, config: Any) -> None:
    """Refuse a role that names no model; nothing is loaded.

    Raises:
        SpecError: with the forms there are.
    """
    scripted = isinstance(config, Mapping) and config.get("backend") == "scripted"
    if not isinstance(config, Mapping) or not (scripted or isinstance(config.get("model"), str)):
        raise SpecError(
            f"{where}: expected {{model: NAME}}, {{model: NAME, adapter: FOLDER}} or {{endpoint: URL, model: NAME}}, "
            f"got {config!r}"
        )
    if "endpoint" in config and "adapter" in config:
        raise SpecError(f"{where}: an endpoint serves adapters under model names of their own; leave `adapter` out")


def helper(config: Mapping[str, Any]) -> LLM:
    """The backend of a role; the same one for the same role.

    Raises:
        SpecError: it cannot be made.
    """
    from agentspec.llm import build_llm

    key = json.dumps(config, sort_keys=True, default=str)
    if key not in _LOADED:
        settings = dict(config)
        if "endpoint" in settings:
            settings |= {"backend": "openai", "base_url": settings.pop("endpoint")}
        try:
            _LOADED[key] = build_llm(settings)
        except ValueError as error:
            raise SpecError(f"helper model {dict(config)}: {error}") from error
    return _LOADED[key]
