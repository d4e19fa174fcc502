"""With `scope: run` a training run carries one memory per task, keeps them in a file, and can start from one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

from datasets import Dataset

from agentspec.carry import FILE, MemoryBank, save_bank, start_bank
from agentspec.episode import Job
from agentspec.files import digest
from agentspec.records.folder import last_complete_checkpoint
from agentspec.records.log import RunLog
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from tests.tiny import tiny_model, tiny_tokenizer
from tests.toy_env import TOY
from tests.trainers.builders import CPU_RUN
from trainers.audit import audit
from trainers.config import ScaffoldConfig
from trainers.credit import ScoredEpisode
from trainers.grpo import ScaffoldGRPOTrainer
from trainers.retroformer import as_retroformer
from trainers.rollouts import rollout_jobs, starting_states, task_rows

TASKS = [Task(TOY, seed, {"steps": 3, "menu": True}) for seed in range(2)]
AGENT: dict[str, Any] = {
    "reasoning": "direct",
    "reflection": {"name": "reflexion", "threshold": 1000},  # every episode leaves a lesson
    "scope": "run",
    "sampling": {"max_tokens": 8},
}


class Watched(ScaffoldGRPOTrainer):
    """Keeps the jobs of every round and what came of them."""

    rounds: list[tuple[list[Job], list[Trajectory]]]

    def _play(self, jobs: Any, spec: Any = None) -> list[ScoredEpisode]:
        episodes = super()._play(jobs, spec)
        self.__dict__.setdefault("rounds", []).append((list(jobs), [e.trajectory for e in episodes]))
        return episodes


def trainer(folder: Path, **changes: Any) -> Watched:
    settings: dict[str, Any] = {
        "output_dir": str(folder),
        "agent": AGENT,
        "train_calls": ["reasoning.*"],
        "per_device_train_batch_size": 2,
        "gradient_accumulation_steps": 2,
        "num_generations": 2,
        "max_steps": 2,
        "save_strategy": "no",
        **CPU_RUN,
        **changes,
    }
    tokenizer = tiny_tokenizer()
    held_out = [Task(TOY, 10_000, {"steps": 3, "menu": True}, "validation")]
    return Watched(
        tiny_model(tokenizer),
        ScaffoldConfig(**settings),
        train_dataset=Dataset.from_list(task_rows(TASKS)),
        eval_dataset=Dataset.from_list(task_rows(held_out)),
        processing_class=tokenizer,
    )


@pytest.mark.parametrize("how", ["first", "best"])
def test_every_task_goes_on_from_one_of_its_own_rollouts(tmp_path: Path, how: str) -> None:
    run = trainer(tmp_path, memory_carry=how)
    run.train()
    (jobs, first), (again, _) = run.rounds
    assert {job.memory_state for job in jobs} == {None}
    for task in TASKS:
        mine = [t for t in first if t.task == task]
        rewards = [t.metrics["return"] for t in mine]
        wanted = mine[0 if how == "first" else rewards.index(max(rewards))].memory_state
        started = {job.memory_state for job in again if job.task == task}
        assert started == {wanted}
    assert len({job.memory_state for job in again}) == len(TASKS)  # tasks share none


def test_the_memories_lie_beside_the_run_and_start_another(tmp_path: Path) -> None:
    run = trainer(tmp_path / "grown")
    run.train()
    bank = MemoryBank.load((tmp_path / "grown" / FILE).read_bytes())
    assert {key for key in bank.states} == {task.key for task in TASKS}
    assert all(bank.of(t.task) for t in run.last_episodes)
    # Held-out tasks are played with what the run has learnt, not with nothing.
    run.evaluate()
    [job] = run.rounds[-1][0]
    assert job.memory_state == bank.as_start().of(job.task) is not None
    # Another run starts where this one ended.
    other = trainer(tmp_path / "other", start_memory=str(tmp_path / "grown"), max_steps=1)
    other.train()
    assert {j.task.key: j.memory_state for j in other.rounds[0][0]} == {t.key: bank.of(t) for t in TASKS}


def test_a_resumed_run_has_the_memories_of_its_checkpoint_until_it_writes_others(tmp_path: Path) -> None:
    """What is carried belongs to a receipt: of the last one, whatever the killed run had written beyond."""
    trainer(tmp_path, save_strategy="steps", save_steps=1).train()
    receipts = RunLog(tmp_path).read("updates.jsonl")
    assert digest((tmp_path / FILE).read_bytes()) == receipts[-1]["chain"]["memory"] != receipts[0]["chain"]["memory"]
    again = trainer(tmp_path, save_strategy="steps", save_steps=1)
    with again._recorded(str(tmp_path / "checkpoint-1")):
        assert digest((tmp_path / FILE).read_bytes()) == receipts[0]["chain"]["memory"]
        assert [v for r in audit(tmp_path) for v in r.violations] == []
        assert last_complete_checkpoint(tmp_path) == tmp_path / "checkpoint-1"  # not one whose records are gone
    (tmp_path / FILE).unlink()
    assert any(FILE in v for r in audit(tmp_path) for v in r.violations)


def test_rollouts_of_a_task_start_alike() -> None:
    bank = MemoryBank(("none", "reflexion")).carried([(TASKS[0].key, 1.0, b'"a"')])
    rows = task_rows([TASKS[0], TASKS[0], TASKS[1]])
    jobs = rollout_jobs(rows, seed=0, round=0, group=2, memory=bank.dump())
    assert [job.memory_state for job in jobs] == [b'"a"', b'"a"', None]
    assert starting_states(TASKS, bank.dump(), unseen=True) == [b'"a"', b'"a"']
    assert starting_states(TASKS, None) == [None, None]


def test_declared_figures_are_logged(tmp_path: Path) -> None:
    run = trainer(tmp_path, max_steps=1, eval_strategy="steps", eval_steps=1)
    run.train()
    [record] = RunLog(tmp_path).read("metrics.jsonl")
    [evaluated] = RunLog(tmp_path).read("evaluations.jsonl")
    earned = [t.metrics["net_earnings"] for t in run.rounds[0][1]]
    assert record["episode/net_earnings"] == pytest.approx(sum(earned) / len(earned))
    assert {"episode/deliveries", "episode/steps", "episode/llm_calls"} <= set(record)
    assert {"eval_net_earnings", "eval_deliveries", "eval_steps"} <= set(evaluated)


def test_a_start_memory_that_cannot_work_is_refused(tmp_path: Path) -> None:
    save_bank(tmp_path / FILE, MemoryBank(("base", "none")))
    with pytest.raises(SpecError, match="give the agent the same modules"):
        trainer(tmp_path / "x", start_memory=str(tmp_path))
    config = ScaffoldConfig(
        output_dir=str(tmp_path / "y"),
        agent={"reflection": {"name": "retroformer", "when": "start"}, "scope": "run"},
        start_memory=str(tmp_path),
        num_generations=2,
        per_device_train_batch_size=2,
        gradient_accumulation_steps=1,
        **CPU_RUN,
    )
    with pytest.raises(SpecError, match="first trials, which start from nothing"):
        as_retroformer(config)
    assert start_bank("", config.spec).states == {}
