"""`agentspec train`: the recipes by name, in one process, wherever they are installed."""

from __future__ import annotations

import argparse
import ast
import importlib
import os
import subprocess
import sys
from typing import Any

from agentspec.cli.ours import ROOT

SEVERAL_PROCESSES = "on several GPUs: accelerate launch -m recipes.NAME --config ..."


def add_parser(commands: Any) -> None:
    """Arguments of `agentspec train`."""
    found = recipes()
    parser = commands.add_parser(
        "train",
        help="train a policy inside a scaffold",
        description="Run a recipe; what follows its name is the recipe's own: `agentspec train NAME --help`.",
        epilog="\n".join(
            ["recipes:", *(f"  {name:<22}{summary}" for name, summary in found.items()), "", SEVERAL_PROCESSES]
        ),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("recipe", metavar="NAME", choices=list(found), help="of a recipe")
    parser.add_argument("options", metavar="...", nargs=argparse.REMAINDER, help="--config FILE|NAME, --FIELD VALUE")
    parser.set_defaults(command=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the recipe as a program of its own would."""
    recipe = importlib.import_module(f"recipes.{arguments.recipe}")
    from recipes.common import run_recipe

    sys.argv = [f"agentspec train {arguments.recipe}", *arguments.options]
    run_recipe(recipe.main)
    return 0


def in_a_process(recipe: str, *options: str) -> float:
    """Run a recipe in a process of its own, of one thread unless the environment says otherwise.

    Returns:
        CPU seconds that it took.

    Raises:
        SystemExit: it failed.
    """
    command = [sys.executable, "-m", "agentspec.cli", "train", recipe, *options]
    print(" ".join(command), file=sys.stderr, flush=True)
    started = subprocess.Popen(command, env={"OMP_NUM_THREADS": "1", **os.environ})
    _, status, usage = os.wait4(started.pid, 0)
    started.returncode = os.waitstatus_to_exitcode(status)
    if started.returncode:
        raise SystemExit(f"{' '.join(command)}: failed (see above); it goes on from its last checkpoint if resumed")
    return usage.ru_utime + usage.ru_stime


def recipes() -> dict[str, str]:
    """Name -> first line of its docstring, of every recipe that is installed; none is imported."""
    found = {}
    for path in sorted((ROOT / "recipes").glob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in tree.body):
            found[path.stem] = (ast.get_docstring(tree) or "").partition("\n")[0]
    return found
