"""Helper models: modules that are answered by another model than the policy (`roles` in a spec).

A role is a backend: `{model: NAME}` (a local model), `{model: NAME, adapter: FOLDER}` (with an adapter on it),
`{adapter: FOLDER}` (on the policy's own model, which is then loaded once more) or `{endpoint: URL, model: NAME}` (an
OpenAI-compatible server); all other keys are those of the backend. A helper is loaded once per process, when it is
first asked. Its calls are metered, budgeted and recorded like the policy's, and
never trained: they are not the policy's choices.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from agentspec.llm import build_llm, check_llm
from agentspec.llm.base import LLM
from agentspec.llm.models import resolve
from agentspec.registry import SpecError

FORMS = ("model", "adapter", "endpoint")
_LOADED: dict[str, LLM] = {}


def check_helper(where: str, config: Any) -> None:
    """Refuse a role that names no model, or what its backend does not take; nothing is loaded.

    Raises:
        SpecError: with the forms there are.
    """
    named = isinstance(config, Mapping) and all(isinstance(config[k], str) for k in FORMS if k in config)
    if not named or not {*config} & {"model", "adapter", "script"}:
        raise SpecError(
            f"{where}: expected {{model: NAME}}, {{model: NAME, adapter: FOLDER}}, {{adapter: FOLDER}} (on the "
            f"policy's model) or {{endpoint: URL, model: NAME}}, got {config!r}"
        )
    if "endpoint" in config and "adapter" in config:
        raise SpecError(f"{where}: an endpoint serves adapters under model names of their own; leave `adapter` out")
    try:
        check_llm(_settings(config) if "model" in config or "script" in config else {**config, "model": "policy"})
    except ValueError as error:
        raise SpecError(f"{where}: {error}") from error


def check_helpers(configs: Iterable[Mapping[str, Any]]) -> None:
    """Find the files of local helpers, and set up those behind an endpoint, before any model is loaded.

    Raises:
        SpecError: an endpoint that cannot be used.
        ModelNotFoundError: no such model or adapter.
    """
    for config in configs:
        if "endpoint" in config or config.get("backend", "local") not in ("local", "vision"):
            helper(config)
        elif "model" in config:
            resolve(config["model"], config.get("adapter"))


def helper(config: Mapping[str, Any]) -> LLM:
    """The backend of a role; the same one for the same role.

    Raises:
        SpecError: it cannot be made.
    """
    key = json.dumps(config, sort_keys=True, default=str)
    if key not in _LOADED:
        if "model" not in config and "script" not in config:
            raise SpecError(f"helper model {dict(config)} names no model, and there is no policy's to put it on")
        try:
            _LOADED[key] = build_llm(_settings(config))
        except ValueError as error:
            raise SpecError(f"helper model {dict(config)}: {error}") from error
    return _LOADED[key]


def _settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """The backend's settings: `endpoint` is short for an OpenAI-compatible one."""
    settings = dict(config)
    if "endpoint" in settings:
        settings |= {"backend": "openai", "base_url": settings.pop("endpoint")}
    return settings
