"""Which LoRA adapter answers which call, when several sit on one base model.

A mapping from shell patterns to adapter names routes calls by their tag path (``module/purpose``), as ``train_calls``
selects them: a pattern without a slash stands for all purposes of its modules, and the first match wins. A scoring has
no tag, so only a pattern that matches everything (``"*"``) routes it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from agentspec.llm.base import LLMError
from agentspec.tags import matches

UNTAGGED = "/"
"""The tag path of what has no tag."""


def check_adapters(model: Any, adapters: Mapping[str, str]) -> None:
    """Raise :class:`LLMError` unless ``model`` is a PEFT model that has every adapter named."""
    if not adapters:
        return
    if not hasattr(model, "get_base_model"):
        raise LLMError(
            f"adapters {dict(adapters)} for a {type(model).__name__}, which is no PEFT model; load the adapters with "
            "`PeftModel.from_pretrained` and `load_adapter`, or leave `adapters` out"
        )
    known = sorted(model.peft_config)
    unknown = sorted(set(adapters.values()) - set(known))
    if unknown:
        raise LLMError(
            f"unknown adapter(s) {', '.join(unknown)}; the model has {', '.join(known)}: name one of these, or load "
            "the adapter with `load_adapter(folder, adapter_name=...)` first"
        )


def adapter_for(path: str, adapters: Mapping[str, str]) -> str:
    """Name of the adapter that answers calls of tag path ``path``; ``""`` (the active one) if no pattern matches.

    >>> adapter_for("reflection.retroformer/reflect", {"reflection.*": "reflector", "*": "actor"})
    'reflector'
    >>> adapter_for(UNTAGGED, {"reflection.*": "reflector", "*": "actor"})
    'actor'
    """
    for pattern, name in adapters.items():
        if matches(path, pattern):
            return name
    return ""


def active_adapter(model: Any) -> str:
    """The adapter in use, ``""`` if the model has none."""
    return str(getattr(model, "active_adapter", ""))


@contextmanager
def using(model: Any, name: str) -> Iterator[None]:
    """Adapter ``name`` is in use inside.

    At the end the one before is, and every parameter's ``requires_grad`` is what it was: PEFT freezes and unfreezes
    adapters as it switches, which an optimiser over one of them must not notice.
    """
    before = active_adapter(model)
    if name == before:
        yield
        return
    stack = model.base_model.active_adapter  # may be several, where the outer model names the first
    trainable = [(p, p.requires_grad) for p in model.parameters()]
    try:
        model.set_adapter(name)
        yield
    finally:
        model.base_model.set_adapter(stack)
        model.active_adapter = before
        for parameter, flag in trainable:
            parameter.requires_grad = flag
