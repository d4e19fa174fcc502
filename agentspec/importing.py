"""Code of the user's own: a module by its name, or a Python file by its path."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from agentspec.literals import suggest


class SpecError(ValueError):
    """A spec, name or configuration that cannot work: what was given, what was expected, what to do."""


def look_here() -> None:
    """From now on what lies in the working directory can be imported; it replaces nothing that is installed."""
    if str(Path.cwd()) not in sys.path and "" not in sys.path:
        sys.path.append(str(Path.cwd()))


def import_module(name: str) -> ModuleType:
    """The module of that name, or of that Python file.

    Raises:
        SpecError: it is not there, would hide another module, or fails when it is imported.
    """
    path = Path(name)
    if path.suffix == ".py" or "/" in name:
        return _import_file(path)
    look_here()
    try:
        return importlib.import_module(name)
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and f"{name}.".startswith(f"{error.name}."):
            raise SpecError(
                f"no module {name!r} to import; give a module that Python finds from here, or the path of a .py file"
            ) from error
        raise SpecError(f"importing {name!r} failed: {type(error).__name__}: {error}") from error


def import_name(target: str, what: str = "") -> Any:
    """What `package.module:name` (or `file.py:name`) names.

    Args:
        target: the name. The working directory counts, after everything that is installed.
        what: what it is for, to begin messages with ("reward").

    Raises:
        SpecError: no such form, no such module, nothing of that name in it, or an import that fails.
    """
    module, colon, name = target.rpartition(":")
    if not (module and colon and name):
        raise SpecError(f"{what} {target!r}: expected package.module:name".strip())
    try:
        found = import_module(module)
    except SpecError as error:
        raise SpecError(f"{what} {target!r}: {error}".strip()) from error
    if not hasattr(found, name):
        near = suggest(name, [n for n, v in vars(found).items() if getattr(v, "__module__", "") == found.__name__])
        raise SpecError(f"{what} {target!r}: there is no {name!r} in the module {module!r}{near}".strip())
    return getattr(found, name)


def _import_file(path: Path) -> ModuleType:
    if not path.is_file() or path.suffix != ".py":
        raise SpecError(f"no file {path} to import; give the path of a Python file, or a module's name")
    loaded = sys.modules.get(path.stem)
    if loaded is not None and getattr(loaded, "__file__", None) == str(path.resolve()):
        return loaded
    found = importlib.util.find_spec(path.stem)
    if loaded is not None or (found is not None and found.origin != str(path.resolve())):
        raise SpecError(f"{path} would hide the module {path.stem!r} that exists already; rename the file")
    location = importlib.util.spec_from_file_location(path.stem, path.resolve())
    assert location is not None and location.loader is not None
    module = sys.modules[path.stem] = importlib.util.module_from_spec(location)
    try:
        location.loader.exec_module(module)
    except Exception as error:
        del sys.modules[path.stem]
        raise SpecError(f"importing {path} failed: {type(error).__name__}: {error}") from error
    return module
