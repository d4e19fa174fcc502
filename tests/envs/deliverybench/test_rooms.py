"""The four rooms of the package: each imports only those before it, and no modules import each other in a circle."""

from __future__ import annotations

import ast
from pathlib import Path

PACKAGE = "agentspec.envs.deliverybench"
FOLDER = Path(__file__).resolve().parents[3] / PACKAGE.replace(".", "/")
ROOMS = ("city", "world", "view", "expert")


def imports() -> dict[str, set[str]]:
    """Module of the package -> modules of the package it imports, for the type checker alone or not."""
    names = {
        ".".join(path.relative_to(FOLDER).with_suffix("").parts).removesuffix(".__init__"): path
        for path in FOLDER.rglob("*.py")
    }
    found: dict[str, set[str]] = {}
    for name, path in names.items():
        found[name] = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE + "."):
                module = str(node.module).removeprefix(PACKAGE + ".")
                inner = {f"{module}.{alias.name}" for alias in node.names} & set(names)
                found[name] |= inner or {module}
    return found


def test_rooms_import_only_those_before_them() -> None:
    wrong = [
        f"{name} imports {target}"
        for name, targets in imports().items()
        for target in targets
        if name.partition(".")[0] in ROOMS
        and (
            target.partition(".")[0] not in ROOMS
            or ROOMS.index(target.partition(".")[0]) > ROOMS.index(name.partition(".")[0])
        )
    ]
    assert not wrong


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = imports()
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join((*path[path.index(name) :], name))
        if name not in done:
            for target in graph.get(name, ()):
                visit(target, (*path, name))
            done.add(name)

    for name in graph:
        visit(name, ())
    assert len(done) > 30
