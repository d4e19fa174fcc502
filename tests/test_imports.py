"""The layers, held by reading the source; and that the scaffold needs no torch, by taking it away."""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tokenize import COMMENT
from tokenize import generate_tokens as tokenize

import pytest

ROOT = Path(__file__).resolve().parents[1]
UPPER = {"trainers", "rewards", "eval", "recipes"}
HEAVY = {"torch", "transformers", "trl", "peft", "accelerate", "datasets"}


def sources(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imports(path: Path, *, anywhere: bool) -> Iterator[tuple[str, int]]:
    """Top-level package names a module imports (in functions too if ``anywhere``), with lines.

    What stands under ``if TYPE_CHECKING:`` is for the type checker and does not count.
    """
    stack: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while stack:
        node = stack.pop()
        if isinstance(node, ast.Import):
            yield from ((alias.name.partition(".")[0], node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level == 0 and node.module:
                yield node.module.partition(".")[0], node.lineno
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            stack += node.orelse
        elif anywhere or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            stack += list(ast.iter_child_nodes(node))


def offences(package: str, forbidden: set[str], *, anywhere: bool, skip: str = "\0") -> list[str]:
    return [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in sources(package)
        if not path.relative_to(ROOT).as_posix().startswith(skip)
        for name, line in imports(path, anywhere=anywhere)
        if name in forbidden
    ]


def test_the_scaffold_never_imports_what_is_built_on_it() -> None:
    assert offences("agentspec", UPPER, anywhere=True, skip="agentspec/cli/") == []


def test_the_scaffold_does_not_name_what_is_built_on_it_even_in_words() -> None:
    """A string can be imported too, and a docstring that explains one layer by another ties them together."""
    path_to = re.compile(rf"(?<![\w./-])(?:{'|'.join(sorted(UPPER))})[./]\w")
    found = []
    for path in sources("agentspec"):
        where = path.relative_to(ROOT).as_posix()
        if where.startswith("agentspec/cli/"):
            continue
        source = path.read_text(encoding="utf-8")
        words = [
            n.value for n in ast.walk(ast.parse(source)) if isinstance(n, ast.Constant) and isinstance(n.value, str)
        ]
        found += [f"{where}: {name!r}" for name in words if name in UPPER - {"eval"}]  # `ast.parse(mode="eval")`
        words += [t.string for t in tokenize(io.StringIO(source).readline) if t.type == COMMENT]
        found += [f"{where}: {match.group()}" for text in words for match in path_to.finditer(text)]
    assert found == []


def test_the_command_line_imports_the_rest_only_inside_its_commands() -> None:
    assert offences("agentspec/cli", UPPER, anywhere=False) == []


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [
        ("eval", {"trainers", "recipes"}),
        ("trainers", {"eval", "recipes"}),
        ("rewards", {"eval", "trainers", "recipes"}),
    ],
)
def test_trainers_and_eval_never_import_each_other(package: str, forbidden: set[str]) -> None:
    assert offences(package, forbidden, anywhere=True) == []


def test_only_the_local_backend_imports_torch_when_loaded() -> None:
    assert offences("agentspec", HEAVY, anywhere=False, skip="agentspec/llm/local") == []
    assert offences("rewards", HEAVY, anywhere=False) == []
    assert offences("eval", HEAVY, anywhere=False) == []


WITHOUT_TORCH = f"""
import importlib.abc, sys

class Blocker(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted(HEAVY)!r}:
            raise ModuleNotFoundError(f"{{name}} is blocked", name=name)

sys.meta_path.insert(0, Blocker())
"""


def run(code: str) -> str:
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


IMPORTS = """
import agentspec, agentspec.spec, agentspec.envs, agentspec.episode, agentspec.llm, agentspec.trajectory
import agentspec.cli.parser
import eval, rewards
"""


def test_the_scaffold_works_without_torch() -> None:
    work = """
from agentspec.spec import AgentSpec
AgentSpec.from_data({"reasoning": "react", "memory": "base"})
from agentspec.cli import main
assert main(["list"]) == 0
"""
    assert "deliverybench" in run(WITHOUT_TORCH + IMPORTS + work)


def test_importing_the_scaffold_does_not_load_torch() -> None:
    run(f"{IMPORTS}\nimport sys\nloaded = set({sorted(HEAVY)!r}) & sys.modules.keys()\nassert not loaded, loaded")
