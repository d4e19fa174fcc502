"""How a name in a spec finds a class.

A name is one of:

- a method of this package: `agentspec/<kind>/<name>.py` (or a folder `<name>` with an `__init__.py`) holds its class,
  and the class its declaration (see `agentspec.declaration`); nothing else is imported to find it;
- `package.module:Class`, anybody's;
- a name of a module that was brought in: by `import_modules` (`--import` on the command line, `imports` in a spec or
  configuration) or by an installed distribution with an entry point in the group `agentspec.modules` (`name =
  package.module:Class`) or `agentspec.envs` (`name = package.module`, which registers environments when imported).

The registry knows no method by itself. A class becomes a module by its methods (a memory has `retrieve` and `store`, a
reasoner `decide`) and by `declaration`.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from types import ModuleType
from typing import Any, Literal

from agentspec.actions import suggest
from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.importing import SpecError, import_module, import_name

__all__ = ["REGISTRY", "CallProfile", "Declaration", "Entry", "Purpose", "Registry", "SpecError", "import_modules"]

Kind = Literal["env", "perception", "memory", "reasoning", "reflection"]
KINDS: tuple[Kind, ...] = ("env", "perception", "memory", "reasoning", "reflection")
METHODS: Mapping[Kind, tuple[str, ...]] = {
    "perception": ("perceive",),
    "memory": ("retrieve", "store"),
    "reasoning": ("decide",),
    "reflection": ("lessons", "revise"),
}
"""Which methods make a class a module of a kind."""

MODULES_GROUP, ENVS_GROUP = "agentspec.modules", "agentspec.envs"


@dataclass(frozen=True)
class Entry:
    """One registered name: where its class is (for environments: the gymnasium id), and what it declares."""

    target: str
    declaration: Declaration = Declaration()
    name: str = ""

    @property
    def summary(self) -> str:
        """One line about it."""
        return self.declaration.summary

    @property
    def calls(self) -> CallProfile:
        """The call profile under default parameters."""
        return self.declaration.calls

    @property
    def purposes(self) -> Mapping[str, Purpose]:
        """What its calls are for."""
        return self.declaration.purposes

    @property
    def needs(self) -> tuple[str, ...]:
        """What it needs of the backend, the environment or the spec."""
        return self.declaration.needs

    @property
    def waived(self) -> Mapping[str, tuple[str, Any]]:
        """Needs that a parameter makes superfluous."""
        return self.declaration.waived

    @property
    def scripted(self) -> bool:
        """Whether it plays what an environment's author scripted."""
        return self.declaration.scripted

    @property
    def presets(self) -> dict[str, CallProfile]:
        """Call profile by preset; empty for a method without presets."""
        return self.declaration.presets

    def needs_with(self, params: Mapping[str, Any]) -> tuple[str, ...]:
        """What the method needs when it is built with `params`: those left out have the constructor's defaults."""
        signature = inspect.signature(self.load()).parameters
        defaults = {name: p.default for name, p in signature.items() if p.default is not inspect.Parameter.empty}
        return self.declaration.needs_with({**defaults, **params})

    def load(self) -> Any:
        """Import the target."""
        return import_name(self.target)

    def describe(self) -> dict[str, Any]:
        """JSON of the entry, as `agentspec list --json` prints it."""
        return {
            "summary": self.summary,
            "calls": asdict(self.calls),
            "purposes": list(self.purposes),
            "needs": list(self.needs),
            "extra": self.declaration.extra,
            "presets": {name: asdict(profile) for name, profile in self.presets.items()},
            "aliases": list(self.declaration.aliases),
            "target": self.target,
        }


class Registry:
    """All names, by kind."""

    def __init__(self, package: str = "agentspec") -> None:
        self._package = package
        self._known: dict[str, dict[str, Entry]] = {kind: {} for kind in KINDS}
        self._complete: set[str] = set()

    @property
    def entries(self) -> Mapping[str, Mapping[str, Entry]]:
        """Kind -> name -> entry. Imports every module there is."""
        return {kind: self.all(kind) for kind in KINDS}

    def all(self, kind: str) -> dict[str, Entry]:
        """Every name of a kind, sorted. Imports all modules of the kind.

        Raises:
            SpecError: no such kind.
        """
        self._require_kind(kind)
        if kind not in self._complete:
            for name in self._files(kind):
                self._from_file(kind, name)
            for point in _entry_points(kind):
                self._from_entry_point(point)
            self._complete.add(kind)
        return dict(sorted(self._known[kind].items()))

    def get(self, kind: str, name: str) -> Entry:
        """The entry of `name` (or of the alias `name`).

        Raises:
            SpecError: unknown kind or name, with the nearest names.
        """
        self._require_kind(kind)
        if kind != "env" and ":" in name:
            return _from_path(kind, name)
        if name not in self._known[kind] and not self._find(kind, name):
            for entry in self.all(kind).values():
                if name in entry.declaration.aliases:
                    return entry
            if name not in self._known[kind]:
                aliases = [a for e in self._known[kind].values() for a in e.declaration.aliases]
                hint = suggest(name, [*self._known[kind], *aliases])
                own = "" if hint.startswith("; did") else "; one of your own is brought in with --import or `imports`"
                raise SpecError(f"unknown {kind} {name!r}{hint}{own}")
        return self._known[kind][name]

    def register(self, kind: Kind, name: str, entry: Entry) -> None:
        """Add a name.

        Raises:
            SpecError: the name is taken by another target.
        """
        self._require_kind(kind)
        known = self._known[kind]
        if name in known and known[name].target != entry.target:
            raise SpecError(f"{kind} {name!r} is already registered as {known[name].target}; choose another name")
        known[name] = Entry(entry.target, entry.declaration, name)

    def unregister(self, kind: Kind, name: str) -> None:
        """Forget a name that was registered."""
        self._known[kind].pop(name, None)

    def add_module(self, module: ModuleType) -> list[str]:
        """Register every class of `module` that has a declaration.

        Returns:
            The names that were added.
        """
        added = []
        for cls in _declared(module):
            kind = kind_of(cls)
            name = cls.declaration.name or snake_case(cls.__name__)
            self.register(kind, name, Entry(f"{module.__name__}:{cls.__name__}", cls.declaration))
            added.append(name)
        return added

    def _require_kind(self, kind: str) -> None:
        if kind not in KINDS:
            raise SpecError(f"unknown kind of module {kind!r}{suggest(str(kind), KINDS)}")

    def _find(self, kind: str, name: str) -> bool:
        """Look for `name` where only it need be imported: a file of this package, an entry point."""
        if kind == "env":
            self.all(kind)
        elif name.isidentifier() and name in self._files(kind):
            self._from_file(kind, name)
        if name not in self._known[kind]:
            for point in _entry_points(kind):
                if point.name == name:
                    self._from_entry_point(point)
        return name in self._known[kind]

    def _files(self, kind: str) -> list[str]:
        if kind == "env":
            importlib.import_module(f"{self._package}.envs")  # registers its own when imported
            return []
        package = importlib.import_module(f"{self._package}.{kind}")
        return [m.name for m in pkgutil.iter_modules(package.__path__)]

    def _from_file(self, kind: str, name: str) -> None:
        """Register what a file (or the `__init__` of a folder) declares: a class without a name gets the file's."""
        module = importlib.import_module(f"{self._package}.{kind}.{name}")
        for cls in _declared(module):
            called = cls.declaration.name or name
            self.register(kind_of(cls), called, Entry(f"{cls.__module__}:{cls.__name__}", cls.declaration))

    def _from_entry_point(self, point: metadata.EntryPoint) -> None:
        """Register what an entry point names: a class under the point's name, a module's classes under theirs.

        Raises:
            SpecError: it cannot be imported, naming the distribution.
        """
        try:
            loaded = point.load()
        except Exception as error:
            source = point.dist.name if point.dist else "a distribution"
            raise SpecError(
                f"entry point {point.name!r} ({point.value}) of {source} cannot be loaded: {error}; reinstall or "
                "remove it"
            ) from error
        if isinstance(loaded, ModuleType):
            self.add_module(loaded)
        elif point.group == MODULES_GROUP and inspect.isclass(loaded):
            target = f"{loaded.__module__}:{loaded.__qualname__}"
            declaration = getattr(loaded, "declaration", Declaration())
            self.register(kind_of(loaded), point.name, Entry(target, declaration))


REGISTRY = Registry()


def register(kind: Kind, name: str, target: str, summary: str, **declared: Any) -> None:
    """Register `name` without a class that declares itself; `declared` are the other fields of the declaration."""
    REGISTRY.register(kind, name, Entry(target, Declaration(summary=summary, **declared)))


def import_modules(names: Sequence[str]) -> None:
    """Bring in outside code: every class with a declaration becomes a name; environments register when imported.

    Args:
        names: importable modules (`my_package.memory`), or paths of Python files (`./my_memory.py`). The working
            directory counts, after everything that is installed.

    Raises:
        SpecError: a module that is not there, or that fails when it is imported.
    """
    for name in names:
        REGISTRY.add_module(import_module(name))


def kind_of(cls: Any) -> Kind:
    """What kind of module a class is, by its methods.

    Raises:
        SpecError: it is none, or several.
    """
    kinds = [kind for kind, methods in METHODS.items() if all(callable(getattr(cls, m, None)) for m in methods)]
    if len(kinds) != 1:
        wanted = "; ".join(f"{kind}: {', '.join(methods)}" for kind, methods in METHODS.items())
        found = " and ".join(kinds) or "no module"
        raise SpecError(f"{cls.__module__}:{cls.__name__} is {found}; a module has the methods of one kind ({wanted})")
    return kinds[0]


def snake_case(name: str) -> str:
    """The class name `CheatSheet` as `cheat_sheet`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).casefold()


def _declared(module: ModuleType) -> Iterator[Any]:
    """The classes with a declaration of their own that `module` defines, itself or, where it is a folder, in a part."""
    for value in list(vars(module).values()):
        if inspect.isclass(value) and "declaration" in vars(value):
            own = value.__module__ == module.__name__
            if own or (hasattr(module, "__path__") and value.__module__.startswith(f"{module.__name__}.")):
                yield value


def _from_path(kind: str, name: str) -> Entry:
    """The entry of `package.module:Class`."""
    cls = import_name(name, kind)
    if not inspect.isclass(cls):
        raise SpecError(f"{kind} {name!r} is no class, but a {type(cls).__name__}; name one: package.module:Class")
    if kind_of(cls) != kind:
        raise SpecError(f"{name} is a {kind_of(cls)} module; the spec names it as {kind}")
    declaration = getattr(cls, "declaration", Declaration())
    return Entry(name, declaration, declaration.name or snake_case(name.rpartition(":")[2]))


def _entry_points(kind: str) -> list[metadata.EntryPoint]:
    return list(metadata.entry_points(group=ENVS_GROUP if kind == "env" else MODULES_GROUP))
