"""Our top-level packages have ordinary names, and a user's folder may hold an `eval.py` or a `rewards/` of its own.

`python -m` and the Python path put such a folder before everything that is installed. So the command line and the
recipes find these four beside the `agentspec` that runs, wherever else a module of that name lies.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

import agentspec
from agentspec.registry import SpecError

PACKAGES = ("eval", "rewards", "trainers", "recipes")
ROOT = Path(agentspec.__file__).resolve().parents[1]


class _Ours(MetaPathFinder):
    """Finds `PACKAGES` in `ROOT`, before anything else is asked."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return PathFinder.find_spec(fullname, [str(ROOT)]) if fullname in PACKAGES else None


def claim_packages() -> None:
    """From here on the names of `PACKAGES` mean ours in this process.

    Raises:
        SpecError: a module of such a name is loaded already and is another one, or ours is not installed.
    """
    for name in PACKAGES:
        loaded = sys.modules.get(name)
        origin = getattr(loaded, "__file__", None) or ""
        if loaded is not None and Path(origin).resolve().parent != ROOT / name:
            raise SpecError(
                f"a module named {name!r} is loaded from {origin or 'an unknown place'}, and agentspec has a package "
                "of that name; rename yours, or run agentspec in a process of its own"
            )
        if PathFinder.find_spec(name, [str(ROOT)]) is None:
            raise SpecError(
                f"the package {name!r} is not beside agentspec in {ROOT}; install it again: pip install agentspec-rl"
            )
    if not any(isinstance(finder, _Ours) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Ours())
