"""Replay of the reference episodes, and of episodes that are wrong on purpose."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from agentspec.envs.deliverybench import replay as module
from agentspec.envs.deliverybench.replay import agree, main, replay, world_for
from tests.envs.deliverybench.helpers import REFERENCE, needs_reference

TRACES = sorted((REFERENCE / "traces").glob("*.json"))


@needs_reference
@pytest.mark.parametrize("path", TRACES, ids=lambda path: path.stem)
def test_reference_episode(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Far tighter than the replay's own tolerances: the traces are printed with six decimals.
    for name, tolerance in {"TIME": 0.01, "PLACE": 2e-5, "LEVEL": 2e-5, "MONEY": 2e-5, "HEAT": 1e-4}.items():
        monkeypatch.setattr(module, name, tolerance)
    assert replay(json.loads(path.read_text()), REFERENCE / "maps") == []


@needs_reference
@pytest.mark.parametrize("path", TRACES, ids=lambda path: path.stem)
def test_reference_report(path: Path) -> None:
    trace = json.loads(path.read_text())
    world = world_for(trace, REFERENCE / "maps")
    for step in trace["steps"]:
        world.step(step["action"])
    want, got = trace["summary"], world.summary()
    money, activity = want["money"]["totals"], want["activity"]
    figures = got["evaluation"]
    assert figures["hourly_profit"] == pytest.approx(want["_derived"]["hourly_profit_lifecycle"], abs=1e-5)
    assert figures["hourly_profit_active"] == pytest.approx(want["_derived"]["hourly_profit_active"], abs=1e-4)
    assert figures["effective_time_ratio"] == pytest.approx(activity["effective_time_ratio"], abs=1e-5)
    assert figures["prevention_rate"] in (None, pytest.approx(want["prevention"]["prevention_rate"], abs=1e-5))
    assert (figures["on_time_rate"] or 0.0) == pytest.approx(want["orders"]["ontime_rate"] or 0.0, abs=1e-5)
    assert json.loads(json.dumps(got)) == got
    bucket = want["capability_buckets"]["high_level_planning"]
    assert got["activity"]["active_time_ratio"] == pytest.approx(bucket["active_time_ratio"], abs=1e-5)
    assert got["activity"]["orders_per_hour"] == pytest.approx(activity["orders_per_hour"], abs=1e-5)
    assert got["money"]["base_wage"] == pytest.approx(money["base_wage"], abs=1e-4)
    assert got["money"]["expenses"]["charging"] == pytest.approx(money["expense_breakdown"]["charging"], abs=1e-4)
    consumed = got["energy"]["personal_consumed_pct"], got["energy"]["battery_consumed_pct"]
    expected = want["energy"]["personal_consumed_pct"], want["energy"]["scooter_batt_consumed_pct"]
    assert consumed == pytest.approx(expected, abs=1e-3)
    assert got["activity"]["mode_seconds"] == pytest.approx(activity["mode_time_s"], abs=1e-6)
    assert got["activity"]["idle_seconds"] == pytest.approx(activity["inactive_time_s_breakdown"], abs=1e-4)
    interruptions = {kind: n for kind, n in want["interruptions"].items() if kind != "total"}
    assert got["interruptions"] == interruptions
    assert got["calls"]["parse_failures"] == want["vlm"]["parse_failures"]
    own = {"MOVE": "move_to", "CHARGE": "charge_escooter", "SWITCH": "switch_transport"}
    attempts = {
        own.get(name, name.lower()): (row["attempts"], row["successes"]) for name, row in got["actions"].items()
    }
    assert attempts == {name: (row["attempts"], row["successes"]) for name, row in want["actions"].items()}


@needs_reference
def test_command_line(tmp_path: Path) -> None:
    lines: list[str] = []
    arguments = ["--maps", str(REFERENCE / "maps"), "--traces"]
    assert main([*arguments, str(TRACES[0])], show=lines.append) == 0
    assert lines[-1] == "1 of 1 episodes match"
    trace: dict[str, Any] = json.loads(TRACES[0].read_text())
    trace["steps"][19]["state"]["energy"] -= 1.0
    wrong = tmp_path / "wrong.json"
    wrong.write_text(json.dumps(trace))
    lines.clear()
    assert main([*arguments, str(tmp_path), "--json"], show=lines.append) == 1
    answer = json.loads(lines[0])
    assert (answer["matched"], answer["total"]) == (0, 1)
    assert answer["mismatches"][0]["mismatch"].startswith("step 19 MOVE")
    assert "energy" in answer["mismatches"][0]["mismatch"]


@pytest.mark.parametrize("place", ["missing", "empty"])
def test_no_episodes(place: str, tmp_path: Path) -> None:
    folder = tmp_path / place
    if place == "empty":
        folder.mkdir()
    with pytest.raises(SystemExit, match="give a reference episode"):
        main(["--maps", str(tmp_path), "--traces", str(folder)])


def test_agree() -> None:
    assert agree([1.0, {"a": 2}], [1.05, {"a": 2}], 0.1)
    assert not agree([1.0], [1.0, 2.0], 0.1)
    assert not agree(True, 1, 0.1)
    assert not agree({"a": 1.0}, {"b": 1.0}, 0.1)
    assert not agree(1.0, None, 0.1)
