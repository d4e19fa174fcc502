"""The page "Your own environment" holds: its example keeps the contract, and its table of keys is the checker's."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import gymnasium
import pytest

from agentspec.envs import check_environment, make_env
from agentspec.envs.contract import INFO_KEYS
from agentspec.envs.making import environment_id
from agentspec.episode import Job, Runner
from agentspec.spec import AgentSpec
from agentspec.types import Task

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "own_environment.md"


def test_the_example_keeps_the_contract(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    [code] = [block for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL) if "class " in block]
    (tmp_path / "corridor.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    try:
        check_environment("corridor:Corridor-v0")
        env = make_env(Task("corridor:Corridor-v0", seed=0, options={"length": 3}))
        env.reset(seed=0)
        paid = [env.step("RIGHT()")[1] for _ in range(4)]
        assert sum(paid) == 1.0  # from cell 0, 1 or 2 the end is at most three steps away, and is paid once
        (played,) = Runner(AgentSpec.from_data({"reasoning": "random"})).run([Job(Task("corridor:Corridor-v0"))])
        assert played.scorable and played.metrics["invalid_actions"] == 0
    finally:
        sys.modules.pop("corridor", None)


def test_the_folder_in_which_one_starts_is_searched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "walled_corridor.py").write_text(
        "import gymnasium\ngymnasium.register('Walled-v0', entry_point='x:Y')\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p not in ("", str(tmp_path))])
    try:
        assert environment_id("walled_corridor:Walled-v0") == "Walled-v0"
    finally:
        sys.modules.pop("walled_corridor", None)
        gymnasium.registry.pop("Walled-v0", None)


def test_the_table_of_keys_is_complete() -> None:
    rows = re.findall(r"^\| ([`a-z_, ]+) \| (required|) ?\|", PAGE.read_text(), re.MULTILINE)
    told = {name: bool(required) for names, required in rows for name in re.findall(r"`(\w+)`", names)}
    assert told == {key.name: key.required for key in INFO_KEYS}
