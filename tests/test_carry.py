"""Memory over episodes: carried per task, in order, and through files."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from agentspec.carry import FILE, MemoryBank, play_in_order, run_in_order, save_bank, start_bank
from agentspec.cli import main
from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.types import Task
from tests.toy_env import TOY

SPEC = AgentSpec.from_data(
    {
        "reasoning": "direct",
        "reflection": {"name": "reflexion", "key": "family", "threshold": 1},
        "scope": "run",
        "layout": "snapshot",
    }
)
A, B, C = (Task(TOY, seed) for seed in range(3))


class Idler:
    """Waits (earning nothing, so that each episode leaves a lesson), and keeps the prompts it acts on."""

    def __init__(self) -> None:
        self.acts: dict[str, list[str]] = {}
        self.lessons = 0

    def __call__(self, request: Request) -> str:
        if request.tag.purpose == "reflect":
            self.lessons += 1
            return f"lesson number {self.lessons}"
        self.acts.setdefault(request.tag.episode, []).append("\n".join(m.text for m in request.messages))
        return "WAIT()"

    @property
    def seen(self) -> list[list[int]]:
        """Per episode the numbers of the lessons that its first prompt shows."""
        return [[n for n in range(1, 9) if f"lesson number {n}" in acts[0]] for acts in self.acts.values()]


def test_each_task_carries_the_memory_of_its_own_rollout() -> None:
    bank = MemoryBank(("none", "reflexion"))
    played = [
        (A.key, 1.0, b'"a0"'),
        (A.key, 3.0, b'"a1"'),
        (B.key, 90.0, b'"b0"'),  # a better return, of another task: it says nothing about A
        (B.key, 95.0, b'"b1"'),
        (C.key, None, b'"c0"'),  # failed: carries nothing
    ]
    first, best = bank.carried(played, "first"), bank.carried(played, "best")
    assert (first.of(A), first.of(B), first.of(C)) == (b'"a0"', b'"b0"', None)
    assert (best.of(A), best.of(B), best.of(C)) == (b'"a1"', b'"b1"', None)
    # A round in which all rollouts of a task fail leaves the task what it had; of equals the first counts.
    later = best.carried([(A.key, None, b'"x"'), (B.key, 2.0, b'"y"'), (B.key, 2.0, b'"z"')], "best")
    assert (later.of(A), later.of(B)) == (b'"a1"', b'"y"')


def test_a_task_that_is_new_starts_from_the_latest_only_where_asked() -> None:
    bank = MemoryBank(("none", "reflexion")).carried([(A.key, 1.0, b'"a"'), (B.key, 1.0, b'"b"')])
    assert bank.of(C) is None  # in training every task grows its own
    assert (bank.as_start().of(C), bank.as_start().of(A)) == (b'"b"', b'"a"')
    assert MemoryBank.load(bank.as_start().dump()) == bank.as_start()


@pytest.mark.parametrize(
    "changed",
    [
        {"modules": []},
        {"states": {"a": 3}},
        {"states": {"a": "garbage"}},
        {"states": {"a": "{}"}},
        {"start": "garbage"},
        {"latest": None, "states": None},
    ],
)
def test_a_memory_file_of_another_shape_is_told(changed: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "memory.json"
    path.write_text(json.dumps({**json.loads(MemoryBank(("none", "reflexion")).dump()), **changed}))
    with pytest.raises(SpecError, match=r"memory\.json: a memory file with broken content .*grow the memory again"):
        start_bank(path, SPEC)


def test_a_state_that_its_modules_cannot_take_up_ends_the_run_with_one_line() -> None:
    state = {"time": {"episode": 1, "before": 2, "ids": {}}, "memory": "", "reflection": "bnVsbA=="}  # null
    bank = MemoryBank(("none", "reflexion"), start=json.dumps(state))
    with pytest.raises(SpecError, match="cannot be taken up by memory 'none' and reflection 'reflexion'"):
        run_in_order(Runner(SPEC, ScriptedLLM(Idler())), [Job(A)], bank)


def test_episodes_in_order_learn_from_each_other() -> None:
    idler = Idler()
    played, bank = run_in_order(Runner(SPEC, ScriptedLLM(idler)), [Job(t) for t in (A, B, C)])
    assert idler.seen == [[], [1], [1, 2]]
    assert [t.task for t in played] == [A, B, C] and bank.latest == C.key
    assert [bank.of(t.task) for t in played] == [t.memory_state for t in played]


def test_episodes_in_order_are_counted_as_one_batch() -> None:
    totals: list[int] = []
    told: list[object] = []

    def progress(total: int) -> Callable[[object], None]:
        totals.append(total)
        return told.append

    played, _ = run_in_order(Runner(SPEC, ScriptedLLM(Idler()), progress=progress), [Job(t) for t in (A, B, C)])
    assert totals == [3] and told == played


def test_a_failed_episode_leaves_the_memory_before_it() -> None:
    idler = Idler()
    broken = Task(TOY, 7, {"fault": "crash"})
    played, bank = run_in_order(Runner(SPEC, ScriptedLLM(idler)), [Job(t) for t in (A, broken, C)])
    assert [t.status for t in played] == ["completed", "failed", "completed"]
    assert idler.seen[-1] == [1] and bank.of(broken) is None


def test_a_memory_file_is_taken_up_by_another_run(tmp_path: Path) -> None:
    _, bank = run_in_order(Runner(SPEC, ScriptedLLM(Idler())), [Job(A), Job(B)])
    save_bank(tmp_path / FILE, bank)
    for source in (tmp_path, tmp_path / FILE):
        idler = Idler()
        runner = Runner(SPEC, ScriptedLLM(idler))
        asyncio.run(play_in_order(runner, [Job(C)], start_bank(source, SPEC)))
        assert idler.seen == [[1, 2]]
    data = json.loads((tmp_path / FILE).read_text())
    assert (data["kind"], data["format"], data["modules"]["reflection"]) == ("agentspec memory", 1, "reflexion")


def test_a_start_that_cannot_work_is_refused(tmp_path: Path) -> None:
    save_bank(tmp_path / FILE, MemoryBank.of_spec(SPEC))
    other = AgentSpec.from_data({"memory": "base", "scope": "run"})
    for source, spec, message in (
        (tmp_path / "none.json", SPEC, "there is no .*none.json"),
        (tmp_path, AgentSpec(), "every episode starts empty; set `scope: run`"),
        (tmp_path, other, r"\('none', 'reflexion'\), the agent has \('base', 'none'\)"),
    ):
        with pytest.raises(SpecError, match=message):
            start_bank(source, spec)
    for text, message in (("{}", "not a memory file"), ("[", "not a memory file"), ("[]", "not a memory file")):
        (tmp_path / FILE).write_text(text)
        with pytest.raises(SpecError, match=message):
            start_bank(tmp_path, SPEC)
    for text, message in (("[" * 100_000, "not a memory file"), ('{"kind": "agentspec memory"}', "format None, this")):
        with pytest.raises(ValueError, match=message):
            MemoryBank.load(text.encode())
    newer = json.loads(MemoryBank.of_spec(SPEC).dump()) | {"format": 2}
    (tmp_path / FILE).write_text(json.dumps(newer))
    with pytest.raises(SpecError, match="format 2, this version reads 1"):
        start_bank(tmp_path, SPEC)
    assert start_bank("", SPEC) == MemoryBank(("none", "reflexion"))


def test_memories_are_given_to_policies_by_name(tmp_path: Path) -> None:
    from agentspec.cli.evaluate import start_memory

    odd = tmp_path / "a=b"
    odd.mkdir()
    assert start_memory([]) == {} and start_memory(["runs/x"]) == "runs/x" and start_memory([str(odd)]) == str(odd)
    assert start_memory(["p=runs/x"]) == {"p": "runs/x"}
    assert start_memory(["p=runs/x", "q=y.json"]) == {"p": "runs/x", "q": "y.json"}
    with pytest.raises(SpecError, match="expected POLICY=FILE for each"):
        start_memory(["runs/x", "runs/y"])


def test_the_command_line_carries_memory_and_keeps_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "agent.yaml").write_text(SPEC.to_yaml())
    idlers: list[Idler] = []

    def build(*_: Any) -> ScriptedLLM:
        idlers.append(Idler())
        return ScriptedLLM(idlers[-1])

    monkeypatch.setattr("agentspec.policies.Policy.build", build)
    monkeypatch.setattr("agentspec.policies.Policy.check", lambda self: None)
    play = ["run", "--env", TOY, "--spec", str(tmp_path / "agent.yaml"), "--policy", "idler", "--json"]
    assert main([*play, "--episodes", "3", "--out", str(tmp_path / "first.jsonl")]) == 0
    assert idlers[0].seen == [[], [1], [1, 2]]
    memory = tmp_path / "first.memory.json"
    assert main([*play, "--seed", "9", "--start-memory", str(memory)]) == 0
    assert idlers[1].seen == [[1, 2, 3]]
