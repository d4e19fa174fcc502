"""A matrix that is killed at any moment and started again gives the table of one that was left alone."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from tests.eval.test_matrix import timeless

ENV = "tests.eval.slow_toy:agentspec-test/SlowToy-v0"
MATRIX = {
    "policies": {"random": None, "scripted": {"backend": "scripted", "script": ["SELL()"]}},
    "scaffolds": {
        "plain": {},
        "react": {"reasoning": "react", "memory": "base"},
        "carried": {"memory": "base", "layout": "snapshot", "scope": "run"},
    },
    "tasks": {
        "short": {"env": ENV, "seeds": "0-7"},
        "long": {"env": ENV, "seeds": "0-7", "options": {"steps": 9}},
    },
    "concurrency": 3,
}
EPISODES = 2 * 3 * 2 * 8


def start(folder: Path, *more: str) -> subprocess.Popen[bytes]:
    config = folder / "matrix.json"  # JSON is YAML
    folder.mkdir(exist_ok=True)
    config.write_text(json.dumps(MATRIX))
    command = [sys.executable, "-m", "agentspec.cli", "eval", "--config", str(config), "--out", str(folder), *more]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def whole_lines(folder: Path) -> list[bytes]:
    path = folder / "episodes.jsonl"
    data = path.read_bytes() if path.is_file() else b""
    return [line for line in data.splitlines(keepends=True) if line.endswith(b"\n")]


def rows(folder: Path) -> list[dict[str, Any]]:
    text = (folder / "results.jsonl").read_text()
    return timeless([json.loads(line) for line in text.splitlines()])


def killed_and_restarted(folder: Path, kills: int, rng: random.Random, *more: str) -> None:
    """Run to the end with `kills` SIGKILLs, each some episodes later; what was finished must stay as it is."""
    for i in range(kills):
        before = whole_lines(folder)
        process = start(folder, *more)
        enough = len(before) + rng.randint(1, (EPISODES - len(before)) // (kills - i + 1))
        while len(whole_lines(folder)) < enough:
            assert process.poll() is None, f"ended by itself with {len(whole_lines(folder))} episodes"
            time.sleep(0.003)
        process.kill()
        process.wait()
        assert whole_lines(folder)[: len(before)] == before
    assert start(folder, *more).wait() == 0


def test_a_matrix_killed_five_times_gives_the_same_table(tmp_path: Path) -> None:
    assert start(tmp_path / "alone").wait() == 0
    killed_and_restarted(tmp_path / "killed", 5, random.Random(0))
    assert rows(tmp_path / "killed") == rows(tmp_path / "alone")
    keys = Counter(json.loads(line)["key"] for line in whole_lines(tmp_path / "killed"))
    assert len(keys) == EPISODES and set(keys.values()) == {1}  # none lost, none played twice


@pytest.mark.slow
def test_the_same_on_ray_workers_with_one_of_them_killed(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="needs ray: pip install 'agentspec-rl[ray]'")
    assert start(tmp_path / "alone").wait() == 0
    process = start(tmp_path / "ray", "--executor", "ray", "--workers", "2")
    while len(whole_lines(tmp_path / "ray")) < EPISODES // 4:
        assert process.poll() is None
        time.sleep(0.01)
    victims = subprocess.run(["pgrep", "-f", "ray::Worker"], capture_output=True, text=True).stdout.split()
    assert victims
    subprocess.run(["kill", "-9", victims[0]], check=True)
    assert process.wait() == 0
    assert rows(tmp_path / "ray") == rows(tmp_path / "alone")
    killed_and_restarted(tmp_path / "both", 2, random.Random(1), "--executor", "ray", "--workers", "2")
    assert rows(tmp_path / "both") == rows(tmp_path / "alone")
