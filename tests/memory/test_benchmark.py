"""The benchmark of memories: its keys, and that the model's time is none of the method's."""

from __future__ import annotations

import asyncio
import json
import time
from typing import Any

import pytest

from agentspec.registry import REGISTRY
from benchmarks.memory import REPEATS, SNAPSHOTS, Filled, Script, Stopwatch, main, methods, with_growth
from tests.fixtures import trial_memories


def test_figures_have_the_keys_that_are_promised(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--json", "--sizes", "20", "40", "--methods", "base"]) == 0
    rows = json.loads(capsys.readouterr().out)["base"]
    assert (
        list(rows) == ["20", "40"] and rows["40"]["filled"] == 20 + REPEATS + SNAPSHOTS
    )  # those of 20 were more already
    assert {"retrieve_p50_ms", "store_p50_ms", "snapshot_ms", "restore_ms", "bytes_per_entry"} <= set(rows["20"])


def test_all_registered_memories_are_measured() -> None:
    everything = {name for name, entry in REGISTRY.all("memory").items() if not entry.declaration.extra}
    assert set(methods()) == everything - {"none"}  # libraries are measured as stores
    assert set(methods(["base"])) == {"base"}
    assert set(methods(["simple"])) == {"base"}  # an alias


def test_a_size_that_takes_too_long_is_said_not_to_be_reached(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--json", "--sizes", "4000", "9000", "--seconds", "0.01", "--methods", "base"]) == 0
    rows = json.loads(capsys.readouterr().out)["base"]
    assert list(rows) == ["4000"] and rows["4000"]["filled"] < 4000
    assert rows["4000"]["not_reached"] == f"0.01 s of storing gave {rows['4000']['filled']} steps"


def test_growth_is_the_snapshots_over_that_of_the_steps() -> None:
    sizes = ((100, 1000), (200, 2000), (400, 2000), (800, 5000))
    rows = with_growth({str(n): {"stored": n, "bytes": b} for n, b in sizes})
    # Twice the steps: twice the bytes (1 / 1), the same bytes (0 / 1), 2.5 times the bytes (1.5 / 1).
    assert [row.get("growth") for row in rows.values()] == [None, 1.0, 0.0, 1.5]


@pytest.fixture
def ranked() -> Any:
    names = REGISTRY.add_module(trial_memories)
    yield
    for name in names:
        REGISTRY.unregister("memory", name)


def test_time_in_model_and_embedder_is_taken_off(ranked: None, monkeypatch: pytest.MonkeyPatch) -> None:
    example = Script._example

    def slow(self: Script, request: Any) -> str:
        began = time.process_time()
        while time.process_time() < began + 0.05:
            pass
        return example(self, request)

    monkeypatch.setattr(Script, "_example", slow)
    filled = Filled("cheat_sheet", {}, dim=16, cached=1000)
    asyncio.run(filled.store())  # one question, of 50 ms
    assert filled.watch.spent >= 0.05
    monkeypatch.setattr("benchmarks.memory.clock", lambda: 10.0)
    # Begun a second ago, and since then three quarters of one in the model: 250 ms are the method's.
    assert Stopwatch(spent=1.75).ms(9.0, 1.0) == 250.0
    assert filled.agent.memory.sheet and not filled.agent.recorder.calls


def test_a_memory_that_raises_is_reported(
    ranked: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def broken(self: Any, input: Any, k: Any = None) -> Any:
        raise KeyError("gone")

    monkeypatch.setattr(trial_memories.Insights, "retrieve", broken)
    assert main(["--json", "--sizes", "10", "--methods", "insights"]) == 1
    assert json.loads(capsys.readouterr().out)["insights"] == {"error": {"error": "KeyError: 'gone'"}}
