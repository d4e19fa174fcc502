"""A package of somebody else's, brought in by `--import` and by entry points, without any change in this project."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(__file__).parent / "fixtures" / "outside_package"
IMPORTS = [f"outside_agents.{name}" for name in ("sticky_notes", "two_minds", "lift")]
NAMES = {"memory": "sticky_notes", "reasoning": "two_minds", "env": "lift"}
SPEC = "{reasoning: two_minds, memory: {name: sticky_notes, every: 2}, perception: generic}"
MODEL = ["--llm", "backend=scripted", "--llm", "script=['go up']"]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package as an installer would leave it: its code, and what its pyproject.toml says of it."""
    target = tmp_path_factory.mktemp("site-packages")
    shutil.copytree(PACKAGE / "outside_agents", target / "outside_agents", ignore=shutil.ignore_patterns("__pycache__"))
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    info = target / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n", encoding="utf-8"
    )
    groups = [
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
        for group, points in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(groups), encoding="utf-8")
    return target


def agentspec(*arguments: str, path: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(path)])}
    command = [sys.executable, "-m", "agentspec.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=170, check=False)


def listed(*arguments: str, path: Path) -> dict[str, Any]:
    done = agentspec("list", "--json", *arguments, path=path)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def imported() -> list[str]:
    return [argument for name in IMPORTS for argument in ("--import", name)]


def test_it_is_not_there_by_itself() -> None:
    found = listed(path=PACKAGE)
    assert all(name not in found[kind] for kind, name in NAMES.items())


@pytest.mark.parametrize("way", ["import", "entry points"])
def test_it_is_listed_with_what_it_declares(installed: Path, way: str) -> None:
    found = listed(*imported(), path=PACKAGE) if way == "import" else listed(path=installed)
    assert all(name in found[kind] for kind, name in NAMES.items())
    assert found["memory"]["sticky_notes"]["calls"]["store"] == [0, 2]
    assert found["memory"]["sticky_notes"]["purposes"] == ["note"]
    assert found["env"]["lift"]["id"] == "outside/Lift-v0"


@pytest.mark.parametrize("way", ["import", "entry points"])
def test_it_runs(installed: Path, way: str) -> None:
    more, path = (imported(), PACKAGE) if way == "import" else ([], installed)
    command = ["run", "--env", "lift", "--policy", "upwards", *MODEL, "--spec", SPEC, "--episodes", "2", "--json"]
    done = agentspec(*command, *more, path=path)
    assert done.returncode == 0, done.stderr
    outcome = json.loads(done.stdout.splitlines()[-1])
    assert outcome["episodes"] == 2 and outcome["failed"] == 0


@pytest.mark.parametrize("way", ["import", "entry points"])
def test_it_is_evaluated(installed: Path, tmp_path: Path, way: str) -> None:
    more, path = (imported(), PACKAGE) if way == "import" else ([], installed)
    command = ["eval", "--env", "lift", "--policies", "upwards", *MODEL, "--specs", f"mine={SPEC}", "--seeds", "0-3"]
    done = agentspec(*command, *more, "--out", str(tmp_path), path=path)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [row["status"] for row in rows] == ["completed"] * 4
    # Always up arrives exactly where somebody waits above; never below.
    assert {row["success"] for row in rows} == {True, False}


@pytest.fixture(params=["import", "entry points"])
def brought_in(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, installed: Path) -> Iterator[str]:
    """The package in this process, by import or found by its entry points when a name is looked up."""
    from agentspec.registry import REGISTRY, import_modules

    if request.param == "import":
        monkeypatch.syspath_prepend(str(PACKAGE))
        import_modules(IMPORTS)
    else:
        monkeypatch.syspath_prepend(str(installed))
        for kind, name in NAMES.items():
            assert REGISTRY.get(kind, name).target.startswith(("outside_agents.", "outside/"))
    yield request.param
    for kind, name in NAMES.items():
        REGISTRY.unregister(kind, name)  # type: ignore[arg-type]  # kinds by name
    for name in IMPORTS:
        sys.modules.pop(name)


@pytest.mark.parametrize("brought_in", ["import"], indirect=True)
def test_it_keeps_the_contract_of_environments(brought_in: str) -> None:
    from agentspec.envs import check_environment

    check_environment("outside/Lift-v0")


def test_two_updates_are_trained_in_it(brought_in: str, tmp_path: Path) -> None:
    pytest.importorskip("trl")
    from datasets import Dataset

    from agentspec.types import Task
    from tests.tiny import tiny_model, tiny_tokenizer
    from tests.trainers.builders import CPU_RUN
    from trainers.audit import audit
    from trainers.config import ScaffoldConfig
    from trainers.grpo import ScaffoldGRPOTrainer
    from trainers.rollouts import task_rows

    tokenizer = tiny_tokenizer()
    config = ScaffoldConfig(
        output_dir=str(tmp_path),
        agent={
            **({"imports": IMPORTS} if brought_in == "import" else {}),
            "perception": "generic",
            "reasoning": {"name": "two_minds", "thought_tokens": 4},
            "memory": {"name": "sticky_notes", "every": 2, "note_tokens": 8},
            "sampling": {"max_tokens": 4},
        },
        train_calls=["reasoning.two_minds", "memory.sticky_notes"],
        train_credits=["executed", "aux"],
        rewards={"env": 1.0},
        per_device_train_batch_size=4,
        num_generations=4,
        max_steps=2,
        **CPU_RUN,
    )
    tasks = [Task("lift", seed, {"floors": 3, "limit": 4}) for seed in range(2)]
    run = ScaffoldGRPOTrainer(
        tiny_model(tokenizer), config, train_dataset=Dataset.from_list(task_rows(tasks)), processing_class=tokenizer
    )
    before = {n: p.detach().clone() for n, p in run.model.named_parameters()}
    run.train()
    receipts = list(audit(tmp_path))
    assert len(receipts) == 2 and [v for r in receipts for v in r.violations] == []
    assert any(not before[n].equal(p) for n, p in run.model.named_parameters())
