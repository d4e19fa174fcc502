"""Language models behind one protocol: local transformers, OpenAI-compatible endpoints, scripted; metered, budgeted.

:func:`build_llm` makes a backend from its entry in a spec; everything heavy is imported only then.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping
from typing import Any

from agentspec.actions import suggest
from agentspec.llm.base import LLM, LLMError

_BACKENDS = {
    "local": ("agentspec.llm.local", "LocalLLM.load", "name_or_path", "'agentspec-rl[train]'"),
    "vision": ("agentspec.llm.vision", "VisionLLM.load", "name_or_path", "'agentspec-rl[train]'"),
    "openai": ("agentspec.llm.openai", "OpenAILLM", "model", "'agentspec-rl[openai]'"),
    "scripted": ("agentspec.llm.scripted", "ScriptedLLM", "script", "agentspec-rl"),
}
# A spec is recorded with every run; a secret must not be in it.
_SECRET = "api_key"


def build_llm(config: Mapping[str, Any]) -> LLM:
    """The backend that ``config`` describes.

    Args:
        config: ``{"backend": "local" | "vision" | "openai" | "scripted", "model": ..., ...}``. ``model`` is a folder,
            bundled name or hub id for ``local`` and ``vision``, the server's model name for ``openai``; ``scripted``
            takes ``script`` (a list of answers) instead. All other keys are keyword arguments of the backend's class.

    Raises:
        ValueError: an unknown backend or key, or a missing one.
        LLMError: the backend cannot be set up (no such model, no key).
    """
    backend = config.get("backend", "local")
    if backend not in _BACKENDS:
        raise ValueError(f"unknown llm backend {backend!r}{suggest(str(backend), _BACKENDS)}")
    module, path, main, extra = _BACKENDS[backend]
    try:
        make: Any = importlib.import_module(module)
    except ImportError as error:
        raise LLMError(
            f"the llm backend {backend!r} cannot be imported ({error}); run `pip install {extra}`"
        ) from error
    for part in path.split("."):
        make = getattr(make, part)
    main_key = "script" if backend == "scripted" else "model"
    allowed = {main_key} | (_keywords(make) - {main, _SECRET})
    arguments = {str(k): v for k, v in config.items() if k != "backend"}
    for key in arguments:
        if key == _SECRET:
            raise ValueError("`api_key` has no place in a spec, which is recorded with every run; use `api_key_env`")
        if key not in allowed:
            raise ValueError(f"unknown key {key!r} for the llm backend {backend!r}{suggest(key, sorted(allowed))}")
    if main_key not in arguments:
        raise ValueError(f"the llm backend {backend!r} needs `{main_key}`; got {sorted(arguments) or 'nothing'}")
    llm: LLM = make(arguments.pop(main_key), **arguments)
    return llm


def _keywords(make: Callable[..., Any]) -> set[str]:
    """Names of all parameters of ``make``; those of its class where it passes ``**kwargs`` on."""
    names: set[str] = set()
    passes_on = False
    for name, parameter in inspect.signature(make).parameters.items():
        if parameter.kind is parameter.VAR_KEYWORD:
            passes_on = True
        else:
            names.add(name)
    owner = getattr(make, "__self__", None)
    if passes_on and inspect.isclass(owner):
        names |= _keywords(owner) - {"model", "tokenizer"}
    return names
