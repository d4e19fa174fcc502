"""A matrix as a file: what it says is played, and what it cannot mean is refused before anything is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("scipy", reason="needs the extra eval")

from agentspec.cli import main
from agentspec.llm.pricing import Price
from agentspec.registry import SpecError
from eval.config import read_matrix
from eval.limits import Limits
from tests.toy_env import TOY

GOOD: dict[str, Any] = {
    "policies": {"random": None, "scripted": {"backend": "scripted", "script": ["SELL()"]}},
    "scaffolds": {"plain": {}, "sheet": "sheet.yaml"},
    "tasks": {"toy": {"env": TOY, "seeds": "3-5", "options": {"steps": 4}}},
}


def write(folder: Path, **changes: Any) -> Path:
    path = folder / "matrix.yaml"
    path.write_text(yaml.safe_dump(GOOD | {"out": str(folder / "out")} | changes))
    (folder / "sheet.yaml").write_text("memory: base\n")
    return path


def test_a_file_says_what_is_played(tmp_path: Path) -> None:
    prices = {"m": {"input": 1, "output": 2}}
    path = write(
        tmp_path, rollouts=2, limits={"cell_s": 5}, prices=prices, sampling={"temperature": 0.5, "stop": ["x"]}
    )
    matrix = read_matrix(path)
    assert [p.name for p in matrix.policies] == ["random", "scripted"] and matrix.episodes == 2 * 2 * 3 * 2
    assert matrix.scaffolds["sheet"].memory.name == "base"  # looked up beside the file
    assert [t.seed for t in matrix.tasks["toy"]] == [3, 4, 5] and matrix.tasks["toy"][0].options == {"steps": 4}
    assert matrix.settings.limits == Limits(cell_s=5) and matrix.settings.prices.table == {"m": Price(1, 2)}
    sampling = matrix.settings.apply(matrix.scaffolds["plain"]).sampling
    assert (sampling.temperature, sampling.stop) == (0.5, ("x",))
    assert main(["eval", "--config", str(path), "--dry-run"]) == 0 and not (tmp_path / "out").exists()


def test_a_file_may_hold_only_what_differs_from_another(tmp_path: Path) -> None:
    write(tmp_path)
    path = tmp_path / "more.yaml"
    path.write_text("extends: matrix.yaml\nrollouts: 3\npolicies: {scripted: null, rule_based: {}}\n")
    matrix = read_matrix(path)
    assert [p.name for p in matrix.policies] == ["random", "rule_based"] and matrix.settings.rollouts == 3
    assert set(matrix.scaffolds) == {"plain", "sheet"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rolouts": 2}, "did you mean rollouts"),
        ({"rollouts": "2"}, "rollouts must be"),
        ({"rollouts": 1.5}, "rollouts must be"),
        ({"seed": "abc"}, "seed must be"),
        ({"timeout_s": "fast"}, "timeout_s must be"),
        ({"timeout_s": -1}, "timeout_s must be above 0"),
        ({"trajectories": "no"}, "trajectories must be"),
        ({"concurrency": 2.5}, "concurrency must be"),
        ({"sampling": [1]}, "sampling must be"),
        ({"sampling": {"temperature": "hot"}}, "temperature must be"),
        ({"sampling": {1: 2}}, "unknown key 1 in sampling"),
        ({"prices": {"m": {"input": "cheap"}}}, "expected input, output and cached"),
        ({"prices": {"m": {"inptu": 1}}}, "expected input, output and cached"),
        ({"limits": {"cel_s": 1}}, "did you mean cell_s"),
        ({"workers": "two"}, "workers must be"),
        ({"out": ["a"]}, "out must be a folder"),
        ({"start_memory": 5}, "start_memory must be"),
        ({"tasks": {"toy": {"env": TOY, "split": "tset"}}}, "unknown split 'tset'"),
        ({"tasks": {"toy": {"evn": TOY}}}, "did you mean env"),
        ({"policies": {"p": {"model": "m", "adapters": []}}}, "one per training run"),
    ],
)
def test_what_a_file_cannot_mean_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises((SpecError, ValueError), match=message):
        read_matrix(write(tmp_path, **changes))


def test_one_episode_is_one_task(tmp_path: Path) -> None:
    """A suite of ten has ten tasks, whatever their seeds are called."""
    grid = {"env": "minigrid", "options": {"suite": "paper"}}
    assert len(read_matrix(write(tmp_path, tasks={"grid": grid | {"seeds": "5-14"}})).tasks["grid"]) == 10
    with pytest.raises(SpecError, match="11 seeds start 10 different episodes"):
        read_matrix(write(tmp_path, tasks={"grid": grid | {"seeds": "0-10"}}))


def test_a_label_that_stands_twice_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path)
    path.write_text(path.read_text().replace("scaffolds:\n", "scaffolds:\n  plain: {memory: base}\n"))
    with pytest.raises(SpecError, match=r"plain stands twice, in the mapping at line"):
        read_matrix(path)


@pytest.mark.parametrize("said", [["--rollouts", "3"], ["--seeds", "4"], ["--limit", "cell_s=1"], ["--max-steps", "2"]])
def test_an_argument_that_the_file_would_overrule_is_refused(
    tmp_path: Path, said: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["eval", "--config", str(write(tmp_path)), *said])
    assert stop.value.code == 2 and f"{said[0]} beside --config" in capsys.readouterr().err


def test_what_is_ray_s_is_refused_without_ray(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["eval", "--config", str(write(tmp_path)), "--workers", "4"])
    assert "workers and address are those of Ray" in capsys.readouterr().err


def test_a_file_is_played_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path)
    assert main(["eval", "--config", str(path), "--json"]) == 0
    assert main(["eval", "--config", str(path), "--json", "--trajectories"]) == 0
    out, err = capsys.readouterr()
    assert "12 episodes were played before trajectories were kept" in err
    path = write(tmp_path, policies={"random": None}, tasks={"toy": GOOD["tasks"]["toy"] | {"seeds": "5-6"}})
    assert main(["eval", "--config", str(path), "--dry-run"]) == 0
    assert "4 episodes, 2 of them in the store" in capsys.readouterr().out  # which holds 12 in all
    cells = json.loads(out.splitlines()[0])
    assert [(c["policy"], c["scaffold"], c["episodes"]) for c in cells] == [
        ("random", "plain", 3),
        ("random", "sheet", 3),
        ("scripted", "plain", 3),
        ("scripted", "sheet", 3),
    ]
