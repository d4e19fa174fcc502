"""A user's own `eval.py`, `rewards.py` or `trainers/` does not take the place of ours."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from agentspec.cli.ours import PACKAGES, ROOT, claim_packages
from agentspec.registry import SpecError


@pytest.fixture
def users_folder(tmp_path: Path) -> Path:
    (tmp_path / "eval.py").write_text("raise RuntimeError('the user\\'s own eval')\n")
    (tmp_path / "rewards.py").write_text("raise RuntimeError('the user\\'s own rewards')\n")
    for name in ("trainers", "recipes"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('the user\\'s own package')\n")
    return tmp_path


def in_folder(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """Python, in `folder` and with it before ours on the path."""
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    return subprocess.run(
        [sys.executable, *command],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


def test_the_command_line_runs_in_a_folder_with_such_names(users_folder: Path) -> None:
    options = ["--option", "size=tiny", "--shift-hours", "0.1", "--max-steps", "3"]
    done = in_folder(users_folder, "-m", "agentspec.cli", "run", "--policy", "rule-based", "--json", *options)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["steps"] <= 3


def test_a_recipe_trains_with_our_trainers(users_folder: Path) -> None:
    pytest.importorskip("trl")
    # `recipes` itself is Python's to find, before any of our code runs.
    (users_folder / "recipes" / "__init__.py").unlink()
    (users_folder / "recipes").rmdir()
    done = in_folder(users_folder, str(ROOT / "recipes" / "grpo_delivery.py"), "--config", "none.yaml")
    assert done.returncode == 2 and done.stderr.startswith(
        "agentspec: error: no such YAML file: none.yaml; give a path to an existing file, or"
    )


def test_another_module_that_is_loaded_already_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = ModuleType("eval")
    theirs.__file__ = "/home/user/eval.py"
    monkeypatch.setitem(sys.modules, "eval", theirs)
    with pytest.raises(SpecError, match=r"'eval' is loaded from /home/user/eval\.py.*rename yours"):
        claim_packages()


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("agentspec.cli.ours.ROOT", tmp_path)
    for name in PACKAGES:
        monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(SpecError, match="install it again: pip install agentspec-rl"):
        claim_packages()


def test_claiming_twice_adds_one_finder() -> None:
    claim_packages()
    before = list(sys.meta_path)
    claim_packages()
    assert sys.meta_path == before
