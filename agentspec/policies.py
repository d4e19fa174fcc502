"""Who acts: a model behind a backend, or a scripted courier that needs none.

A policy is applied to a scaffold: a model policy keeps the scaffold as it is; a scripted one takes the place of its
reasoning, and modules that would call a model are switched off, since there is none.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from agentspec.actions import suggest
from agentspec.embedding import embedder_of
from agentspec.files import file_digest
from agentspec.llm import build_llm, capabilities_of, check_llm
from agentspec.llm.base import LLM
from agentspec.llm.helpers import check_helpers
from agentspec.llm.models import SHIPPED, base_of, resolve
from agentspec.registry import REGISTRY, SpecError
from agentspec.simulator import can_simulate
from agentspec.spec import MODULE_KINDS, AgentSpec, ModuleSpec

SCRIPTED = ("rule_based", "random")
"""Reasoning modules that are policies of their own."""


@dataclass(frozen=True)
class Policy:
    """A policy to evaluate.

    Args:
        name: label in rows and tables; ``rule_based`` and ``random`` (``-`` for ``_`` is fine) are the scripted ones.
        model: folder, bundled name or hub id; empty: ``name`` is the model.
        adapter: PEFT folder on top of the model, or empty.
        backend: further settings of the backend (``backend``, ``base_url``, ``dtype``, ...); default: the local one.
        run: which training run of a recipe this is, where several runs are one policy of a table.
    """

    name: str
    model: str = ""
    adapter: str = ""
    backend: Mapping[str, Any] = field(default_factory=dict)
    run: str = ""

    @classmethod
    def parse(cls, text: str, **settings: Any) -> Policy:
        """From ``NAME``, ``NAME=MODEL`` or ``NAME=MODEL+ADAPTER`` (a path may stand for the model).

        Raises:
            SpecError: an empty name or model.
        """
        if text.replace("-", "_") in SCRIPTED:
            return cls(text.replace("-", "_"))
        name, given, model = text.partition("=")
        model, _, adapter = (model if given else name).partition("+")
        if not name or not model:
            raise SpecError(f"policy {text!r}: expected NAME, NAME=MODEL or NAME=MODEL+ADAPTER")
        label = name if given else Path(model).name if Path(model).is_dir() else model
        return cls(label, model, adapter, **settings)

    @property
    def scripted(self) -> str:
        """Name of the reasoning module that is this policy, or empty for a model."""
        name = self.name.replace("-", "_")
        return name if name in SCRIPTED and not self.model and not self.backend else ""

    def apply(self, spec: AgentSpec) -> AgentSpec:
        """The scaffold as this policy plays it.

        Raises:
            SpecError: a helper model that is an adapter alone, and this policy has no local model to put it on.
        """
        if not self.scripted:
            return self._with_helpers(spec)
        quiet = {
            kind: ModuleSpec("none")
            for kind in ("memory", "reflection")
            if calls_model(kind, getattr(spec, kind).name) or REGISTRY.get(kind, getattr(spec, kind).name).needs
        }
        return replace(spec, reasoning=ModuleSpec(self.scripted), **quiet)  # type: ignore[arg-type]  # kinds are fields

    def _with_helpers(self, spec: AgentSpec) -> AgentSpec:
        """Helper models that are an adapter alone stand on this policy's model."""
        settings = self.settings()
        based = spec.with_base(base_of(str(settings.get("model", ""))))
        if based is not spec and settings["backend"] != "local":
            raise SpecError(
                f"roles: an adapter alone stands on the policy's model, and {self.name} is served by the backend "
                f"{settings['backend']!r}; name the model it belongs to: {{model: NAME, adapter: FOLDER}}"
            )
        return based

    def settings(self) -> dict[str, Any]:
        """What :func:`agentspec.llm.build_llm` builds this policy's backend from."""
        settings = {"backend": "local", "model": self.model or self.name, **self.backend}
        if "script" in settings:
            del settings["model"]  # a scripted backend has a script in the model's place
        return settings | ({"adapter": self.adapter} if self.adapter else {})

    def check(self) -> None:
        """Check the backend's settings and find the model's files before anything runs.

        Raises:
            ValueError: settings that the backend does not take.
            ModelNotFoundError: no such model or adapter, with the remedy.
        """
        settings = self.settings()
        if self.scripted:
            return
        check_llm(settings)
        if settings["backend"] in ("local", "vision"):
            from agentspec.llm.models import BUNDLED, ModelNotFoundError

            try:
                resolve(settings["model"], self.adapter or None)
            except ModelNotFoundError as error:
                known = [*(name.replace("_", "-") for name in SCRIPTED), *BUNDLED]
                hint = suggest(settings["model"], known)
                if settings["model"] in known or not hint.startswith("; did you mean"):
                    raise
                raise ModelNotFoundError(f"{error}{hint}") from None

    def build(self) -> LLM | None:
        """The backend, loaded; ``None`` for a scripted policy."""
        return None if self.scripted else build_llm(self.settings())

    def identity(self) -> dict[str, Any]:
        """What makes two policies the same: the backend's settings, and weights by their content, wherever they lie."""
        if self.scripted:
            return {"scripted": self.scripted}
        return weighed(self.settings())


def weighed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a backend with every folder of weights replaced by its digest."""
    found = dict(settings)
    for name in ("model", "adapter"):
        text = found.get(name)
        if isinstance(text, str) and text:
            shipped = (SHIPPED / text,) if name == "adapter" else ()
            folder = next((path for path in (Path(text).expanduser(), *shipped) if path.is_dir()), None)
            found[name] = f"weights:{weights_digest(folder)}" if folder else text
    return found


def check_agent(policy: Policy | None, spec: AgentSpec, env: Any, name: str) -> None:
    """Everything that can be refused before a model is loaded: settings, files, helpers, and what modules need.

    Args:
        policy: who acts, if anybody is named.
        spec: the scaffold as the policy plays it.
        env: an environment of the kind that is played.
        name: of the environment.

    Raises:
        SpecError: something that a module needs is not there, or a setting that nobody takes.
        ModelNotFoundError: no such model or adapter.
    """
    if policy is not None and not policy.scripted:
        policy.check()
        check_helpers(config for pattern, config in spec.roles.items() if spec.helped(pattern))
        settings = policy.settings()
        spec.check(capabilities_of(settings) | {"snapshots"}, f"backend {settings['backend']!r}")
        if isinstance(spec.embedder, Mapping) and "endpoint" in spec.embedder:
            embedder_of(spec.embedder)  # which asks it once
    if not can_simulate(env):
        spec.check(frozenset(spec.needs()) - {"snapshots"}, f"environment {name!r} without snapshot() and restore()")


def calls_model(kind: str, name: str) -> bool:
    """Whether a registered module may call the model, by its declared profile."""
    calls = REGISTRY.get(kind, name).calls
    return any(most > 0 for _, most in (calls.retrieve, calls.store, calls.step, calls.episode))


def needs_model(spec: AgentSpec) -> bool:
    """Whether any module of the scaffold may call the model."""
    return any(calls_model(kind, getattr(spec, kind).name) for kind in MODULE_KINDS)


def weights_digest(folder: Path) -> str:
    """16 hex digits over the names and bytes of a folder's files that decide what a model says.

    Weights, configurations, tokenizer and chat template; not what a trainer leaves beside them. Files are read whole,
    once per process while their size and time of change stay.
    """
    files = sorted({path for pattern in WEIGHTS for path in folder.glob(pattern)})
    parts = [f"{path.name}:{_file_digest(path, *_stamp(path))}" for path in files]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def _stamp(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns


WEIGHTS = ("*.safetensors", "*config.json", "tokenizer*", "special_tokens_map.json", "vocab.*", "merges.txt", "*.jinja")
"""Names of those files."""


@functools.cache
def _file_digest(path: Path, size: int, changed_ns: int) -> str:
    return file_digest(path)
