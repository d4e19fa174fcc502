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
import json
import random
from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import yaml

from agentspec.actions import suggest
from agentspec.context import Context, Layout, Placement
from agentspec.llm.helpers import check_helper
from agentspec.llm.none import NoLLM
from agentspec.llm.recorder import Budget, ModuleLLM, Recorder, derive_seed
from agentspec.parameters import check_parameters, check_types
from agentspec.protocols import Embedder, Services, StepClock
from agentspec.registry import REGISTRY, SpecError, import_modules, snake_case
from agentspec.types import Sampling
from agentspec.yaml_keys import UniqueLoader

if TYPE_CHECKING:
    from agentspec.agent import Agent

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
        entry = REGISTRY.get(kind, name)
        check_parameters(f"{kind} {name!r}", entry.load(), params)
        return cls(name if ":" in name else entry.name, params)

    @property
    def short(self) -> str:
        """The name in tables and call tags: of `package.module:Class` the class's own."""
        return self.name if ":" not in self.name else snake_case(self.name.partition(":")[2])

    def to_data(self) -> Any:
        """YAML-able: the bare name when there are no parameters."""
        return {"name": self.name, **self.params} if self.params else self.name


@dataclass(frozen=True)
class AgentSpec:
    """One agent: four modules, the prompt layout, sampling defaults and a budget per episode.

    `scope` says whether memory lives for one `episode` (every episode starts empty) or for the whole `run`. What is
    recalled has at most `recall_tokens` tokens in a step, lessons of a reflector `lesson_tokens`; with `recall: newest`
    both stand in the newest user turn only, with `recall: kept` in every turn (see :mod:`agentspec.context`).

    `embedder` names what turns text into vectors for the modules that need it. `roles` gives modules a helper model in
    place of the policy: pattern over module names (`memory.*`) -> a backend (see :mod:`agentspec.llm.helpers`); its
    calls are metered and never trained. `imports` brings in modules of your own (see :mod:`agentspec.registry`).
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
    embedder: str | Mapping[str, Any] = ""
    roles: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    imports: tuple[str, ...] = ()
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
        if "imports" in values:
            names = [values["imports"]] if isinstance(values["imports"], str) else values["imports"]
            check_types("spec", cls, {"imports": names})
            import_modules(names)
            values["imports"] = tuple(names)
        for kind in MODULE_KINDS:
            if kind in values:
                values[kind] = ModuleSpec.parse(kind, values[kind])
        for key, kept in (("sampling", Sampling), ("budget", Budget)):
            if key in values:
                values[key] = _dataclass(kept, values[key], key)
        check_types("spec", cls, {k: v for k, v in values.items() if k in _PLAIN})
        spec = cls(**values)
        spec.validate()
        return spec

    def validate(self) -> None:
        """Refuse what cannot be built, whether or not it is going to be (a policy may bring reasoning of its own).

        Raises:
            SpecError: a value out of range, an unknown embedder or role, or a module that refuses its parameters.
        """
        for key, lowest in (("max_turns", 0), ("recall_tokens", 0), ("lesson_tokens", 0)):
            if getattr(self, key) < lowest:
                raise SpecError(f"{key} must be at least {lowest}, got {getattr(self, key)}")
        for kind in MODULE_KINDS:
            module: ModuleSpec = getattr(self, kind)
            if REGISTRY.get(kind, module.name).declaration.scope not in ("", self.scope):
                raise SpecError(
                    f"{kind} {module.name!r} learns from one episode for the next, but `scope: {self.scope}` ends with "
                    "each; set `scope: run`, or choose another module"
                )
        self._check_roles()
        if self.embedder:
            from agentspec.embedding import check_embedder

            check_embedder(self.embedder)
        self._build(Recorder(NoLLM(), episode="", seed=0), None)

    @classmethod
    def from_yaml(cls, source: str | Path) -> AgentSpec:
        """From a YAML file, or from YAML text if ``source`` is no existing file."""
        return cls.from_data(load_yaml(source))

    def to_data(self) -> dict[str, Any]:
        """Plain data that :meth:`from_data` reads back to an equal spec; defaults of sampling and budget left out."""
        data: dict[str, Any] = {kind: getattr(self, kind).to_data() for kind in MODULE_KINDS}
        data |= {k: getattr(self, k) for k in ("layout", "max_turns", "scope", "embedder")}
        data |= {k: getattr(self, k) for k in ("recall", "recall_tokens", "lesson_tokens")}
        data |= {"roles": {k: dict(v) for k, v in self.roles.items()}} if self.roles else {}
        data |= {"imports": list(self.imports)} if self.imports else {}
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

    def with_base(self, model: str) -> AgentSpec:
        """The spec with helper models that are an adapter alone put on `model`, the policy's own."""
        roles = {k: v if {*v} & {"model", "script"} else {**v, "model": model} for k, v in self.roles.items()}
        return self if roles == self.roles else dataclasses.replace(self, roles=roles)

    @property
    def label(self) -> str:
        """Short name for tables: ``react+base``, with reflection and layout where they are not the default."""
        parts = [self.reasoning.short, self.memory.short]
        if self.reflection.name != "none":
            parts.append(self.reflection.short)
        return "+".join(parts) + ("" if self.layout == "conversation" else f" ({self.layout})")

    def needs(self) -> set[str]:
        """What the modules need of the backend and the environment, together."""
        return {need for kind in MODULE_KINDS for need in self._needs_of(kind)}

    def _needs_of(self, kind: str) -> tuple[str, ...]:
        module: ModuleSpec = getattr(self, kind)
        needs: tuple[str, ...] = REGISTRY.get(kind, module.name).needs_with(module.params)
        return (*needs, "images") if kind == "perception" and module.params.get("images") else needs

    def call_paths(self) -> list[str]:
        """`module/purpose` paths of the calls that the modules may make, as patterns over calls match them."""
        paths = []
        for kind in MODULE_KINDS:
            module: ModuleSpec = getattr(self, kind)
            entry = REGISTRY.get(kind, module.name)
            if entry.calls.calls_model:
                paths += [f"{kind}.{module.short}/{purpose}" for purpose in entry.purposes or ("*",)]
        return paths

    def check(self, capabilities: frozenset[str], who: str) -> None:
        """Refuse a backend that lacks what a module needs.

        Args:
            capabilities: what is offered, `snapshots` by an environment and `embedder` by the caller included.
            who: who offers it, e.g. `backend 'local'`.

        Raises:
            SpecError: naming the module, what it needs and the remedy.
        """
        offered = capabilities | ({"embedder"} if self.embedder else frozenset())
        for kind in MODULE_KINDS:
            missing = [n for n in self._needs_of(kind) if n not in offered]
            if missing == ["embedder"]:
                name = getattr(self, kind).name
                raise SpecError(f"{kind} {name!r} needs an embedder; set `embedder: minilm` (or `hash`) in the spec")
            if missing:
                entry = REGISTRY.get(kind, getattr(self, kind).name)
                waivers = [f"set `{p}: {v}`" for p, v in (entry.waived[n] for n in missing if n in entry.waived)]
                remedy = " or ".join([*waivers, f"choose another {kind} module or {who.split(maxsplit=1)[0]}"])
                raise SpecError(
                    f"{kind} {getattr(self, kind).name!r} needs {', '.join(missing)}, which {who} does not offer "
                    f"(it offers {', '.join(sorted(capabilities)) or 'nothing of the kind'}); {remedy}"
                )

    def build(self, recorder: Recorder, *, embedder: Embedder | None = None) -> Agent:
        """A fresh :class:`~agentspec.agent.Agent` for one episode, its modules wired to `recorder`.

        Args:
            recorder: the episode's model calls.
            embedder: in place of the one that the spec names.
        """
        if embedder is None and self.embedder:
            from agentspec.embedding import embedder_of

            embedder = embedder_of(self.embedder)
        return self._build(recorder, embedder)

    def _build(self, recorder: Recorder, embedder: Embedder | None) -> Agent:
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
            arguments: tuple[Any, ...] = ()
            if kind != "perception":
                path = names[kind] = f"{kind}.{spec.short}"
                rng = random.Random(derive_seed(recorder.seed, path))
                new_id = functools.partial(clock.new_id, path)
                module_llm = ModuleLLM(recorder, path)
                carried = self.scope == "run"
                provided.append(Services(module_llm, context, clock, rng, embedder, new_id, carried=carried))
                arguments = (provided[-1],)
            try:
                modules[kind] = cls(*arguments, **spec.params)
            except SpecError:
                raise
            except (TypeError, ValueError, OverflowError) as error:
                raise SpecError(f"{kind} {spec.name!r}: {error}") from error
        return Agent(context=context, clock=clock, recorder=recorder, services=tuple(provided), names=names, **modules)

    def helped(self, pattern: str) -> list[str]:
        """The modules that a pattern of `roles` names."""
        return [module for module in self._modules() if fnmatchcase(module, pattern)]

    def _modules(self) -> list[str]:
        return [f"{kind}.{getattr(self, kind).short}" for kind in MODULE_KINDS[1:]]

    def _check_roles(self) -> None:
        """Refuse roles of no module, and backends that say neither what nor where."""
        for pattern, backend in self.roles.items():
            if not isinstance(pattern, str):
                raise SpecError(f"roles: expected a pattern over module names such as 'memory.*', got {pattern!r}")
            if not self.helped(pattern):
                modules = ", ".join(self._modules())
                raise SpecError(f"roles: {pattern!r} matches none of the modules {modules}")
            check_helper(f"roles: {pattern!r}", backend)


_FIELDS = [f.name for f in dataclasses.fields(AgentSpec)]
_PLAIN = ("layout", "max_turns", "scope", "recall", "recall_tokens", "lesson_tokens", "embedder", "roles")


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
    check_types(where, cls, value)
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
    if text.lstrip()[:1] in ("{", "["):
        try:
            return json.loads(text)  # YAML reads JSON too, except for numbers such as 1e-4
        except ValueError:
            pass
    try:
        return yaml.load(text, Loader=UniqueLoader)  # a safe loader
    except SpecError as error:
        raise SpecError(f"{where}: {error}; keep one") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        position = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "malformed"
        raise SpecError(f"malformed YAML in {where}{position}: {problem}; check indentation and quotes") from error
