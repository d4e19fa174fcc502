"""``AgentSpec``: an agent as data. Names and parameters <-> YAML <-> a built agent.

::

    perception: generic
    memory: {name: base, window: 5}
    reasoning: react
    reflection: none
    layout: conversation
    sampling: {temperature: 1.0, max_tokens: 64}
    budget: {calls: 200}

Change one line and the same policy runs, trains or is evaluated inside another scaffold.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import random
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from agentspec.actions import suggest
from agentspec.context import Context, Layout, Placement
from agentspec.llm.recorder import Budget, ModuleLLM, Recorder, derive_seed
from agentspec.protocols import Embedder, Services, StepClock
from agentspec.registry import REGISTRY, SpecError
from agentspec.types import Sampling

MODULE_KINDS = ("perception", "memory", "reasoning", "reflection")


@dataclass(frozen=True)
class ModuleSpec:
    """A registered name and its keyword parameters."""

    name: str
    params: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def parse(cls, kind: str, value: Any) -> ModuleSpec:
        """From YAML: a name, or a mapping with ``name`` and parameters.

        Raises:
            SpecError: neither, an unknown name, or a parameter the class does not take.
        """
        if isinstance(value, ModuleSpec):
            value = value.to_data()
        if isinstance(value, str):
            name, params = value, {}
        elif isinstance(value, Mapping) and isinstance(value.get("name"), str):
            name, params = value["name"], {k: v for k, v in value.items() if k != "name"}
        else:
            raise SpecError(f"{kind}: expected a name or a mapping with 'name', got {value!r}")
        accepted = _parameters(REGISTRY.get(kind, name).load())
        for key in params:
            if key not in accepted:
                raise SpecError(f"{kind} {name!r} has no parameter {key!r}{suggest(key, accepted)}")
        return cls(name, params)

    def to_data(self) -> Any:
        """YAML-able: the bare name when there are no parameters."""
        return {"name": self.name, **self.params} if self.params else self.name


def _parameters(target: Any) -> list[str]:
    """Names of the keyword parameters of a module class (``services`` is the scaffold's)."""
    return [p for p in inspect.signature(target).parameters if p != "services"]


@dataclass(frozen=True)
class AgentSpec:
    """One agent: four modules, the prompt layout, sampling defaults and a budget per episode.

    `scope` says whether memory lives for one `episode` (every episode starts empty) or for the whole `run`. What is
    recalled has at most `recall_tokens` tokens in a step, lessons of a reflector `lesson_tokens`; with `recall: newest`
    both stand in the newest user turn only, with `recall: kept` in every turn (see :mod:`agentspec.context`).
    """

    perception: ModuleSpec = ModuleSpec("generic")
    memory: ModuleSpec = ModuleSpec("none")
    reasoning: ModuleSpec = ModuleSpec("direct")
    reflection: ModuleSpec = ModuleSpec("none")
    layout: Layout = "conversation"
    max_turns: int = 0
    scope: Literal["episode", "run"] = "episode"
    recall: Placement = "newest"
    recall_tokens: int = 512
    lesson_tokens: int = 256
    embedder: str = ""
    sampling: Sampling = Sampling()
    budget: Budget = Budget()

    @classmethod
    def from_data(cls, data: Any) -> AgentSpec:
        """From parsed YAML.

        Raises:
            SpecError: unknown keys, names or parameters, with the nearest known ones.
        """
        if isinstance(data, AgentSpec):
            return data
        if not isinstance(data, Mapping):
            raise SpecError(f"a spec is a mapping of {', '.join(_FIELDS)}; got {type(data).__name__}: {data!r}")
        for key in data:
            if key not in _FIELDS:
                raise SpecError(f"unknown key {key!r} in spec{suggest(str(key), _FIELDS)}")
        values: dict[str, Any] = dict(data)
        for kind in MODULE_KINDS:
            if kind in values:
                values[kind] = ModuleSpec.parse(kind, values[kind])
        if "sampling" in values:
            values["sampling"] = _dataclass(Sampling, values["sampling"], "sampling")
        if "budget" in values:
            values["budget"] = _dataclass(Budget, values["budget"], "budget")
        spec = cls(**values)
        if spec.layout not in ("conversation", "snapshot"):
            raise SpecError(f"layout must be 'conversation' or 'snapshot', got {spec.layout!r}")
        if spec.scope not in ("episode", "run"):
            raise SpecError(f"scope must be 'episode' or 'run', got {spec.scope!r}")
        if spec.recall not in ("newest", "kept"):
            raise SpecError(f"recall must be 'newest' or 'kept', got {spec.recall!r}")
        return spec

    @classmethod
    def from_yaml(cls, source: str | Path) -> AgentSpec:
        """From a YAML file, or from YAML text if ``source`` is no existing file."""
        return cls.from_data(load_yaml(source))

    def to_data(self) -> dict[str, Any]:
        """Plain data that :meth:`from_data` reads back to an equal spec; defaults of sampling and budget left out."""
        data: dict[str, Any] = {kind: getattr(self, kind).to_data() for kind in MODULE_KINDS}
        data |= {k: getattr(self, k) for k in ("layout", "max_turns", "scope", "embedder")}
        data |= {k: getattr(self, k) for k in ("recall", "recall_tokens", "lesson_tokens")}
        for key in ("sampling", "budget"):
            value, default = getattr(self, key), type(getattr(self, key))()
            fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
            changed = {k: v for k, v in fields.items() if v != getattr(default, k)}
            if changed:
                data[key] = {k: list(v) if isinstance(v, tuple) else v for k, v in changed.items()}
        return data

    def to_yaml(self) -> str:
        """YAML text of :meth:`to_data`."""
        return yaml.safe_dump(self.to_data(), sort_keys=False)

    @property
    def label(self) -> str:
        """Short name for tables: ``react+base``, with reflection and layout where they are not the default."""
        parts = [self.reasoning.name, self.memory.name]
        if self.reflection.name != "none":
            parts.append(self.reflection.name)
        return "+".join(parts) + ("" if self.layout == "conversation" else f" ({self.layout})")

    def needs(self) -> set[str]:
        """What the modules need of the backend and the environment, together."""
        return {need for kind in MODULE_KINDS for need in self._needs_of(kind)}

    def _needs_of(self, kind: str) -> tuple[str, ...]:
        module: ModuleSpec = getattr(self, kind)
        needs: tuple[str, ...] = REGISTRY.get(kind, module.name).needs_with(module.params)
        return (*needs, "images") if kind == "perception" and module.params.get("images") else needs

    def check(self, capabilities: frozenset[str], who: str) -> None:
        """Refuse a backend that lacks what a module needs.

        Raises:
            SpecError: naming the module, what it needs and the remedy.
        """
        for kind in MODULE_KINDS:
            missing = [n for n in self._needs_of(kind) if n not in capabilities]
            if missing:
                entry = REGISTRY.get(kind, getattr(self, kind).name)
                waivers = [f"set `{p}: {v}`" for p, v in (entry.waived[n] for n in missing if n in entry.waived)]
                remedy = " or ".join([*waivers, f"choose another {kind} module or {who.split(maxsplit=1)[0]}"])
                raise SpecError(
                    f"{kind} {getattr(self, kind).name!r} needs {', '.join(missing)}, which {who} does not offer "
                    f"(it offers {', '.join(sorted(capabilities)) or 'nothing of the kind'}); {remedy}"
                )

    def build(self, recorder: Recorder, *, embedder: Embedder | None = None) -> Any:
        """A fresh :class:`~agentspec.agent.Agent` for one episode, its modules wired to ``recorder``."""
        from agentspec.agent import Agent

        clock = StepClock()
        context = Context(
            self.layout,
            self.max_turns,
            recall=self.recall,
            recall_tokens=self.recall_tokens,
            lesson_tokens=self.lesson_tokens,
            count_tokens=recorder.llm.count_tokens,
            window=recorder.llm.max_context,
        )
        modules: dict[str, Any] = {}
        provided: list[Services] = []
        names: dict[str, str] = {}
        for kind in MODULE_KINDS:
            spec: ModuleSpec = getattr(self, kind)
            cls = REGISTRY.get(kind, spec.name).load()
            if kind == "perception":
                modules[kind] = cls(**spec.params)
                continue
            path = f"{kind}.{spec.name}"
            rng = random.Random(derive_seed(recorder.seed, path))
            names[kind] = path
            new_id = functools.partial(clock.new_id, path)
            provided.append(Services(ModuleLLM(recorder, path), context, clock, rng, embedder, new_id))
            modules[kind] = cls(provided[-1], **spec.params)
        return Agent(context=context, clock=clock, recorder=recorder, services=tuple(provided), names=names, **modules)


_FIELDS = [f.name for f in dataclasses.fields(AgentSpec)]


def _dataclass(cls: Any, value: Any, where: str) -> Any:
    """Build dataclass ``cls`` from a mapping, refusing unknown keys."""
    if isinstance(value, cls):
        return value
    if not isinstance(value, Mapping):
        raise SpecError(f"{where}: expected a mapping, got {value!r}")
    names = [f.name for f in dataclasses.fields(cls)]
    for key in value:
        if key not in names:
            raise SpecError(f"unknown key {key!r} in {where}{suggest(str(key), names)}")
    try:
        return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in value.items()})
    except (TypeError, ValueError) as error:
        raise SpecError(f"{where}: {error}") from error


def load_yaml(source: str | Path) -> Any:
    """Parse YAML from a file (if one exists at ``source``) or from text.

    Raises:
        SpecError: malformed YAML, with line and column, or a file that does not exist.
    """
    text = str(source)
    is_text = isinstance(source, str) and ("\n" in text or ":" in text)
    if not is_text or ("\n" not in text and Path(text).is_file()):
        path = Path(source)
        if not path.is_file():
            raise SpecError(f"no such YAML file: {path}; give a path to an existing file")
        text, where = path.read_text(encoding="utf-8"), str(path)
    else:
        where = "the given text"
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        position = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "malformed"
        raise SpecError(f"malformed YAML in {where}{position}: {problem}; check indentation and quotes") from error
