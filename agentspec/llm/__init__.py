"""Language models behind one protocol: local transformers, OpenAI-compatible endpoints, scripted; metered, budgeted.

:func:`build_llm` makes a backend from its entry in a spec; everything heavy is imported only then.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
from collections.abc import Callable, Mapping
from typing import Any

from agentspec.actions import suggest
from agentspec.llm.base import LLM, LLMError
from agentspec.parameters import check_types
from agentspec.registry import SpecError

_TORCH = ("torch", "transformers")
_BACKENDS: dict[str, tuple[str, str, str, tuple[str, ...], str]] = {
    "local": ("agentspec.llm.local", "LocalLLM.load", "name_or_path", _TORCH, "'agentspec-rl[train]'"),
    "vision": ("agentspec.llm.vision", "VisionLLM.load", "name_or_path", _TORCH, "'agentspec-rl[train]'"),
    "openai": ("agentspec.llm.openai", "OpenAILLM", "model", ("httpx",), "'agentspec-rl[openai]'"),
    "scripted": ("agentspec.llm.scripted", "ScriptedLLM", "script", (), "agentspec-rl"),
}
# Where it is, what makes it of which argument, which packages that takes, and what installs them.
# A spec is recorded with every run; a secret must not be in it.
_SECRET = "api_key"
_OWN = ("self", "kwargs", "tokenizer", "processor")
# Parameters of constructors that no configuration can give.


def build_llm(config: Mapping[str, Any]) -> LLM:
    """The backend that ``config`` describes.

    Args:
        config: ``{"backend": "local" | "vision" | "openai" | "scripted", "model": ..., ...}``. ``model`` is a folder,
            bundled name or hub id for ``local`` and ``vision``, the server's model name for ``openai``; ``scripted``
            takes ``script`` (a list of answers) instead. All other keys are keyword arguments of the backend's class.

    Raises:
        ValueError: an unknown backend or key, a missing one, or a value of the wrong type.
        LLMError: the backend cannot be set up (no such model, no key).
    """
    make, main, arguments = _prepared(config)
    llm: LLM = make(main, **arguments)
    return llm


def check_llm(config: Mapping[str, Any]) -> None:
    """Refuse what `build_llm` would, except for what shows only when the backend is made; imports no torch.

    Raises:
        ValueError: as `build_llm`.
        LLMError: a package that is not installed.
    """
    _prepared(config)


def capabilities_of(config: Mapping[str, Any]) -> frozenset[str]:
    """What the backend of ``config`` offers to modules, without loading a model.

    Raises:
        ValueError: as `build_llm`.
        LLMError: as `build_llm`, except for what shows only when a model is loaded.
    """
    make, _, _ = _prepared(config)
    offered = getattr(getattr(make, "__self__", make), "capabilities", None)
    return offered if isinstance(offered, frozenset) else build_llm(config).capabilities


def _prepared(config: Mapping[str, Any]) -> tuple[Callable[..., Any], Any, dict[str, Any]]:
    """What makes the backend, its main argument, and the others: all of them known, and of the right type."""
    backend = config.get("backend", "local")
    if not isinstance(backend, str) or backend not in _BACKENDS:
        raise ValueError(f"unknown llm backend {backend!r}{suggest(str(backend), _BACKENDS)}")
    module, path, main, packages, extra = _BACKENDS[backend]
    missing = [package for package in packages if importlib.util.find_spec(package) is None]
    if missing:
        raise LLMError(f"the llm backend {backend!r} needs {', '.join(missing)}; run `pip install {extra}`")
    make: Any = importlib.import_module(module)
    for part in path.split("."):
        make = getattr(make, part)
    main_key = "script" if backend == "scripted" else "model"
    makers = _makers(make)
    allowed = {*(name for m in makers for name in inspect.signature(m).parameters)} - {main, _SECRET, *_OWN}
    allowed |= {main_key}
    arguments = {str(k): v for k, v in config.items() if k != "backend"}
    for key in arguments:
        if key == _SECRET:
            raise ValueError("`api_key` has no place in a spec, which is recorded with every run; use `api_key_env`")
        if key not in allowed:
            raise ValueError(f"unknown key {key!r} for the llm backend {backend!r}{suggest(key, sorted(allowed))}")
    if main_key not in arguments:
        raise ValueError(f"the llm backend {backend!r} needs `{main_key}`; got {sorted(arguments) or 'nothing'}")
    for maker in makers:
        check_types(f"llm backend {backend!r}", maker, {k: v for k, v in arguments.items() if k != main_key})
    for key, value in arguments.items():
        lowest = 0 if key == "max_retries" else 1 if key.startswith("max_") and not key.endswith("_key") else None
        if lowest is not None and isinstance(value, int) and value < lowest:
            raise SpecError(f"llm backend {backend!r}: {key} is {value}; expected at least {lowest}")
    return make, arguments.pop(main_key), arguments


def _makers(make: Any) -> list[Any]:
    """What is called with the keys of a configuration: ``make``, and its class where it passes ``**kwargs`` on."""
    owner = getattr(make, "__self__", None)
    passes_on = any(p.kind is p.VAR_KEYWORD for p in inspect.signature(make).parameters.values())
    if passes_on and inspect.isclass(owner):
        return [make, owner.__init__]
    return [make.__init__ if inspect.isclass(make) else make]
