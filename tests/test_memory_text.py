"""What a carried memory holds, as text: printed, written, compared."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from agentspec.carry import FILE, MemoryBank, run_in_order, save_bank
from agentspec.cli import main
from agentspec.episode import Job, Runner
from agentspec.memory_text import _lines, _readable, diff, text
from agentspec.registry import REGISTRY
from agentspec.spec import AgentSpec
from agentspec.types import Task
from tests.fixtures import trial_memories
from tests.memory.recall_world import RECALL, Reader, fact_of

TASKS = [Task(RECALL, seed, {"delay": 3, "part": "show"}) for seed in (0, 1)]


@pytest.fixture(autouse=True)
def trials() -> Iterator[None]:
    names = REGISTRY.add_module(trial_memories)
    yield
    for name in names:
        REGISTRY.unregister("memory", name)


def grown(memory: str, tasks: list[Task]) -> MemoryBank:
    spec = AgentSpec.from_data({"memory": memory, "scope": "run", "layout": "snapshot", "embedder": "hash"})
    return run_in_order(Runner(spec, Reader()), [Job(task) for task in tasks])[1]


def test_json_is_written_out_line_by_line() -> None:
    state = {"sheet": "one\ntwo", "empty": "", "steps": [{"text": "a", "vector": [0.5] * 9}, "b"], "n": 0, "off": False}
    # Texts of several lines are indented below their name; what is empty says nothing; nine numbers are too many.
    assert list(_lines(state)) == [
        "sheet:",
        "  one",
        "  two",
        "steps:",
        "  - text: a",
        "    vector:",
        "      (9 numbers)",
        "  - b",
        "n: 0",
        "off: False",
    ]
    assert (_readable(b'{"a":1}'), _readable(b"eyJhIjoxfQ=="), _readable(b"plain"), _readable(b"\xff")) == (
        {"a": 1},
        {"a": 1},
        "plain",
        "(1 bytes)",
    )


def test_a_memory_file_is_printed_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bank = grown("cheat_sheet", TASKS)
    save_bank(tmp_path / FILE, bank)
    assert main(["view", "--memory", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("memory: cheat_sheet, reflection: none, 2 tasks")
    first, second = shown.split(f"task {TASKS[1].key} (latest)")
    # The second episode began with the sheet of the first: it holds both facts.
    assert fact_of(0)[1] in first and fact_of(1)[1] not in first
    assert fact_of(0)[1] in second and fact_of(1)[1] in second and "2 episodes, 6 steps" in second
    assert (
        main(["view", "--memory", str(tmp_path / FILE), "--task", TASKS[0].key[:6], "--to", str(tmp_path / "a")]) == 0
    )
    assert fact_of(0)[1] in (tmp_path / "a").read_text() and TASKS[1].key not in (tmp_path / "a").read_text()
    capsys.readouterr()
    assert main(["view", "--memory", str(tmp_path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["modules"]["memory"] == "cheat_sheet" and fact_of(1)[1] in told["states"][TASKS[1].key]["memory"]


def test_two_memories_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short, long = grown("cheat_sheet", TASKS[:1]), grown("cheat_sheet", TASKS)
    assert diff(short, short) == ["no difference"]
    # Both know the first task, and hold the same of it.
    assert diff(short, long) == ["no difference"]
    other = grown("cheat_sheet", TASKS[1:])
    lines = diff(short, other)  # no task in common: what each carried last
    assert any(fact_of(0)[1] in line for line in lines if line.startswith("-"))
    assert any(fact_of(1)[1] in line for line in lines if line.startswith("+"))
    for name, bank in (("a", short), ("b", other)):
        save_bank(tmp_path / name, bank)
    assert main(["view", "--memory", str(tmp_path / "a"), "--diff", str(tmp_path / "b")]) == 0
    assert capsys.readouterr().out.splitlines() == lines


def test_a_memory_may_say_itself_what_it_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    sheet = trial_memories.CheatSheet
    monkeypatch.setattr(sheet, "describe", lambda self: f"A sheet of {len(self.sheet)} characters", raising=False)
    assert "    A sheet of" in "\n".join(text(grown("cheat_sheet", TASKS[:1])))
    # One that is not there any more, or that raises, is shown as its JSON.
    bank = grown("cheat_sheet", TASKS[:1])
    REGISTRY.unregister("memory", "cheat_sheet")
    assert fact_of(0)[1] in "\n".join(text(bank))


def test_what_cannot_be_shown_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_bank(tmp_path / FILE, grown("cheat_sheet", TASKS))
    (tmp_path / "broken").write_text("{")
    for arguments, message in (
        ((), "give a file of trajectories, or --memory"),
        (("x.jsonl", "--memory", str(tmp_path)), "not both"),
        (("x.jsonl", "--json"), "--json goes with --memory"),
        (("--memory", str(tmp_path / "none")), "there is no"),
        (("--memory", str(tmp_path / "broken")), "not a memory file"),
        (("--memory", str(tmp_path), "--task", "zzz"), "names 0 entries"),
        (("--memory", str(tmp_path), "--diff", str(tmp_path), "--task", "zzz"), "no task that both files hold"),
        (("--memory", str(tmp_path), "--diff", str(tmp_path), "--json"), "leave out --json"),
    ):
        with pytest.raises(SystemExit) as refusal:
            main(["view", *arguments])
        assert refusal.value.code == 2 and message in capsys.readouterr().err
