"""Retroformer: the reflector learns from what its lessons change; actor and base stay as they are, bit for bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("trl")
pytest.importorskip("peft")

from datasets import Dataset
from peft import LoraConfig, get_peft_model

from agentspec.episode import Job
from agentspec.records.log import RunLog
from agentspec.reflection.retroformer import PATH
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory, read_trajectories
from agentspec.types import Task
from rewards import RewardSet
from tests.tiny import tiny_model, tiny_tokenizer
from tests.trainers.builders import CPU_RUN, call, episode
from tests.trainers.played import toy_tasks
from tests.trainers.test_resume import _stop_after
from trainers.audit import audit
from trainers.config import ScaffoldConfig
from trainers.credit import ScoredEpisode
from trainers.forward import rows_logprobs
from trainers.policy import ACTOR, TRAINED, load_actor_and_reflector, load_policy
from trainers.retroformer import RetroformerTrainer, as_retroformer, play_trials
from trainers.rollouts import task_rows
from trainers.sequences import Row, TrainFilter, build_sequences

AGENT = {
    "reasoning": "direct",
    "reflection": {"name": "retroformer", "threshold": 100.0, "reflection_tokens": 6, "trial_tokens": 200},
    "sampling": {"max_tokens": 8},
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A base model, and an actor and a reflector whose weights are no longer those that LoRA begins with."""
    root = tmp_path_factory.mktemp("weights")
    tokenizer = tiny_tokenizer()
    tiny_model(tokenizer).save_pretrained(root / "base")
    tokenizer.save_pretrained(root / "base")
    for seed, name in enumerate(("actor", "reflector")):
        model = get_peft_model(tiny_model(tokenizer), LoraConfig(r=2, target_modules=["q_proj", "v_proj", "up_proj"]))
        torch.manual_seed(seed)
        for key, parameter in model.named_parameters():
            if "lora_" in key:
                parameter.data.normal_(std=0.3)
        model.save_pretrained(root / name)
    return {name: str(root / name) for name in ("base", "actor", "reflector")}


def config(folder: Path, folders: dict[str, str], **changes: Any) -> ScaffoldConfig:
    settings: dict[str, Any] = {
        "output_dir": str(folder),
        "model": folders["base"],
        "actor_adapter": folders["actor"],
        "adapter": folders["reflector"],
        "agent": AGENT,
        "actor_temperature": 0.9,  # the tiny actor's greedy choice is the same whatever it is told
        "per_device_train_batch_size": 2,
        "gradient_accumulation_steps": 4,
        "num_generations": 4,
        "max_steps": 2,
        "save_strategy": "no",
        **CPU_RUN,
        "shuffle_dataset": False,
        **changes,
    }
    return ScaffoldConfig(**settings)


def trainer(folder: Path, folders: dict[str, str], **changes: Any) -> RetroformerTrainer:
    args = as_retroformer(config(folder, folders, **changes))
    args.check()
    model, tokenizer = load_actor_and_reflector(args)
    data = Dataset.from_list(task_rows(toy_tasks()))
    return RetroformerTrainer(
        model, args, train_dataset=data, eval_dataset=data.select(range(2)), processing_class=tokenizer
    )


def weights(run: RetroformerTrainer) -> dict[str, torch.Tensor]:
    return {n: p.detach().clone() for n, p in run.model.named_parameters()}


def logged(folder: Path, round: int) -> tuple[list[Trajectory], list[Trajectory]]:
    """First trials and episodes of a round."""
    (first,) = (folder / "first_trials").glob(f"{round:06d}*.jsonl")
    (later,) = (folder / "trajectories").glob(f"{round:06d}*.jsonl")
    return list(read_trajectories(first)), list(read_trajectories(later))


# --- two updates -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, folders: dict[str, str]) -> Any:
    """A run of two updates: trainer, its folder, the weights before."""
    folder = tmp_path_factory.mktemp("run")
    run = trainer(folder, folders)
    before = weights(run)
    run.train()
    run.save_model(str(folder))
    return run, folder, before


def test_only_the_reflector_changes(trained: Any) -> None:
    run, _, before = trained
    after = weights(run)
    changed = {n for n in before if not torch.equal(before[n], after[n])}
    assert changed == {n for n in before if f".{TRAINED}." in n} and changed
    assert any(f".{ACTOR}." in n for n in before)
    optimised = {id(p) for group in run.optimizer.param_groups for p in group["params"]}
    assert optimised == {id(p) for n, p in run.model.named_parameters() if n in changed}
    assert {n for n, p in run.model.named_parameters() if p.requires_grad} == changed


def test_a_group_reflects_on_one_failed_trial(trained: Any) -> None:
    _, folder, _ = trained
    for round in range(2):
        firsts, episodes = logged(folder, round)
        assert len(firsts) == 2 and len(episodes) == 8
        for i, trajectory in enumerate(episodes):
            first = firsts[i // 4]
            assert trajectory.task == first.task
            (lesson,) = [c for c in trajectory.calls if c.tag.path == PATH]
            (reference,) = [c for c in episodes[i // 4 * 4].calls if c.tag.path == PATH]
            assert lesson.prompt_ids == reference.prompt_ids and lesson.id == 0
            # The change of return, by what was recorded of the two trials.
            total = sum(t.reward for t in trajectory.transitions) - sum(t.reward for t in first.transitions)
            assert trajectory.metrics["reflection/reward"] == pytest.approx(total)
            assert RewardSet({"reflection_gain": 1.0}).score(trajectory).total == pytest.approx(total)
            assert {c.sampling.temperature for c in trajectory.calls if c is not lesson} == {0.9}
            assert lesson.sampling.temperature == 1.0
            # And the lesson stands in what the actor reads.
            text = " ".join(lesson.text.split())
            prompt = tiny_tokenizer().decode(trajectory.calls[1].prompt_ids)
            assert not text or f"Trial 0: {text}" in prompt
        assert len({c.text for t in episodes[:4] for c in t.calls if c.tag.path == PATH}) > 1
        lessons = [c for t in episodes for c in t.calls if c.tag.path == PATH]
        assert len(lessons) == 8 and len({c.prompt_ids for c in lessons}) == 2  # two failed trials, four lessons each


def test_the_audit_is_clean_and_lessons_alone_are_trained(trained: Any) -> None:
    _, folder, _ = trained
    receipts = list(audit(folder))
    assert len(receipts) == 2 and [v for r in receipts for v in r.violations] == []
    assert all(set(r.by_tag) == {PATH} and r.trained == r.denominator > 0 for r in receipts)
    records = RunLog(folder).read("metrics.jsonl")
    assert all(r["sampling/logp_difference_max"] < 1e-5 for r in records)
    assert all(r["reflection/failed_first_trials"] == 1.0 for r in records)
    for record, round in zip(records, range(2), strict=True):
        gains = [t.metrics["reflection/reward"] for t in logged(folder, round)[1]]
        assert record["reflection/gain"] == pytest.approx(sum(gains) / 8) == pytest.approx(record["reward"])


def test_every_call_is_answered_by_its_adapter(tmp_path: Path, folders: dict[str, str]) -> None:
    """Recomputed with its own adapter a call has the log-probabilities it was sampled with, and not with the other."""
    run = trainer(tmp_path, folders, max_steps=1, learning_rate=0.0)
    run.train()
    difference = {}
    for adapter in (ACTOR, TRAINED):
        run.model.set_adapter(adapter)
        for pattern in ("reasoning.*", PATH):
            filter = TrainFilter((pattern,))
            rows = [Row(s, 1.0, 0) for t in run.last_episodes for s in build_sequences(t, filter)]
            with torch.no_grad():
                logps = rows_logprobs(run.model, rows)[0]
            sampled = [[row.sequence.logprobs, row.sequence.mask] for row in rows]
            gaps = [
                abs(logps[i, p - 1].item() - values[p])
                for i, (values, mask) in enumerate(sampled)
                for p in range(len(mask))
                if mask[p]
            ]
            difference[adapter, pattern] = max(gaps)
    assert difference[ACTOR, "reasoning.*"] < 1e-5 > difference[TRAINED, PATH]
    assert difference[TRAINED, "reasoning.*"] > 1e-2 < difference[ACTOR, PATH]


@pytest.mark.parametrize("changes", [{}, {"num_iterations": 2, "gradient_accumulation_steps": 2}, {"beta": 0.1}])
def test_a_resumed_run_equals_the_uninterrupted_one(
    tmp_path: Path, folders: dict[str, str], changes: dict[str, Any]
) -> None:
    settings = {"max_steps": 3, "save_strategy": "steps", "save_steps": 1, **changes}
    whole = trainer(tmp_path / "whole", folders, **settings)
    whole.train()
    first = trainer(tmp_path / "cut", folders, **settings)
    first.add_callback(_stop_after(1))
    first.train()
    resumed = trainer(tmp_path / "cut", folders, **settings)
    resumed.train(resume_from_checkpoint=str(tmp_path / "cut" / "checkpoint-1"))
    expected, got = weights(whole), weights(resumed)
    assert expected.keys() == got.keys() and all(torch.equal(expected[n], got[n]) for n in expected)
    trainable = {n for n, p in resumed.model.named_parameters() if p.requires_grad}
    assert trainable == {n for n in got if f".{TRAINED}." in n}
    assert [v for r in audit(tmp_path / "cut") for v in r.violations] == []


def test_what_is_saved_holds_both_adapters(trained: Any, folders: dict[str, str], tmp_path: Path) -> None:
    from trainers.export import export

    run, folder, _ = trained
    expected = weights(run)
    again, _ = load_actor_and_reflector(run.args, folder)
    got = {n: p.detach() for n, p in again.named_parameters()}
    assert expected.keys() == got.keys() and all(torch.equal(expected[n], got[n]) for n in expected)
    # An export of the run is the reflector, as one adapter on the base.
    exported = export(folder, tmp_path / "out")
    single, _ = load_policy(config(tmp_path, folders, adapter=str(exported), actor_adapter=""))
    mine = {n: p.detach() for n, p in single.named_parameters() if f".{TRAINED}." in n}
    assert mine and all(torch.equal(expected[n], mine[n]) for n in mine)
    assert not any(f".{ACTOR}." in n for n, _ in single.named_parameters())


# --- what there is nothing to learn from -----------------------------------------------------------------------------


def test_a_round_without_a_failed_trial_trains_nothing(tmp_path: Path, folders: dict[str, str]) -> None:
    agent = {**AGENT, "reflection": {**AGENT["reflection"], "threshold": -1.0}}
    run = trainer(tmp_path, folders, agent=agent, weight_decay=0.0)
    before = weights(run)
    run.train()
    assert all(torch.equal(before[n], w) for n, w in weights(run).items())
    firsts, episodes = logged(tmp_path, 0)
    assert all(t.calls == firsts[i // 4].calls and t.rollout == i % 4 for i, t in enumerate(episodes))
    receipts = list(audit(tmp_path))
    assert [(r.rows, r.trained, r.violations) for r in receipts] == [(0, 0, [])] * 2
    assert RunLog(tmp_path).read("metrics.jsonl")[0]["reflection/failed_first_trials"] == 0.0


def test_trials_of_groups(tmp_path: Path) -> None:
    """Only failed first trials are followed, each by the whole of its group, from the memory it left."""
    asked: list[list[Job]] = []
    fates = {0: "due", 1: "good", 2: "failed", 3: "due"}

    def play(jobs: Sequence[Job]) -> list[ScoredEpisode]:
        asked.append(list(jobs))
        trajectories = [
            Trajectory(
                job.task,
                {},
                job.rollout,
                job.seed,
                metrics={"reflection/due": True} if fates[job.task.seed] == "due" else {},
                status="failed" if fates[job.task.seed] == "failed" else "completed",
                memory_state=f"after {job.task.seed}".encode(),
            )
            for job in jobs
        ]
        return [ScoredEpisode(t, RewardSet({"env": 1.0}).score(t)) for t in trajectories]

    jobs = [Job(Task("toy", seed), rollout, 5) for seed in fates for rollout in range(2)]
    scored_firsts, scored = play_trials(play, jobs)
    firsts, episodes = [e.trajectory for e in scored_firsts], [e.trajectory for e in scored]
    assert [t.task.seed for t in firsts] == [0, 1, 2, 3]
    heads, followed = asked
    assert {h.seed for h in heads}.isdisjoint({j.seed for j in jobs})  # other draws than those of the next trial
    assert followed == [replace(j, memory_state=f"after {j.task.seed}".encode()) for j in jobs if j.task.seed in (0, 3)]
    assert [(t.task.seed, t.rollout) for t in episodes] == [(j.task.seed, j.rollout) for j in jobs]
    assert [t.scorable for t in episodes] == [True] * 4 + [False] * 2 + [True] * 2
    assert len({t.episode for t in episodes}) == len(jobs)


def test_the_actor_is_greedy_by_default_and_lessons_are_sampled(folders: dict[str, str], tmp_path: Path) -> None:
    run = trainer(tmp_path, folders, max_steps=1, actor_temperature=ScaffoldConfig.actor_temperature)
    run.train()
    temperatures = {(c.tag.path, c.sampling.temperature) for t in run.last_episodes for c in t.calls}
    assert temperatures == {("reasoning.direct/act", 0.0), (PATH, 1.0)}
    # Greedy: until a lesson says otherwise, the same trial.
    firsts, _ = logged(tmp_path, 0)
    again = run._play([Job(t.task, 0, 77) for t in firsts])
    assert len(again) == 2
    assert [t.action_text for t in run._first_trials[0].trajectory.transitions] == [
        t.action_text for t in firsts[0].transitions
    ]


def test_validation_plays_two_trials(tmp_path: Path, folders: dict[str, str]) -> None:
    run = trainer(tmp_path, folders, eval_strategy="steps", eval_steps=1, save_strategy="steps", save_steps=1)
    before = weights(run)
    metrics = run.evaluate()
    assert metrics == run.evaluate() and metrics["eval_unscorable"] == 0.0
    gains = {t.task.key: sum(s.reward for s in t.transitions) for t in (e.trajectory for e in run._first_trials)}
    assert len(gains) == 2 and metrics["eval_llm_calls"] == 4.0  # three actions, and a lesson before them
    assert all(torch.equal(before[n], w) for n, w in weights(run).items())


# --- the reward ------------------------------------------------------------------------------------------------------


def test_the_gain_per_step_sums_to_the_change_of_return() -> None:
    paid = replace(episode([call(0, [1], [2])], (2.0, 0.5, 1.0)), metrics={"reflection/return_before": 1.25})
    gain = RewardSet({"reflection_gain": 1.0})
    # 2 - 1.25, 0.5, 1: in all 3.5 - 1.25.
    assert gain.score(paid).terms == {"reflection_gain": (0.75, 0.5, 1.0)} and gain.score(paid).total == 2.25
    assert gain.score(replace(paid, metrics={})).total == 0.0 and gain.score(replace(paid, status="failed")) is None


# --- what is refused -------------------------------------------------------------------------------------------------

REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "another reflection": ({"agent": {"reflection": "reflexion"}}, "reflection: retroformer"),
    "lessons at the end": ({"agent": {"reflection": {"name": "retroformer", "when": "end"}}}, "when: start"),
    "no lessons": ({"agent": {"reflection": {"name": "retroformer", "control": "x"}}}, "none is sampled"),
    "greedy lessons": ({"agent": {"reflection": {"name": "retroformer", "temperature": 0}}}, "temperature is 0"),
    "a trained actor": ({"train_calls": ["reasoning.*", PATH]}, "the actor is frozen"),
    "another reward": ({"rewards": {"earning_delta": 1.0}}, "reflection_gain"),
    "all weights": ({"lora_r": 0, "adapter": ""}, "lora_r is 0"),
    "vLLM": ({"use_vllm": True}, "one set of weights"),
    "a warm actor": ({"actor_temperature": -1.0}, "actor_temperature is -1.0"),
    "no such actor": ({"actor_adapter": "no-such-actor"}, "no-such-actor"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_work_is_refused(tmp_path: Path, folders: dict[str, str], what: str) -> None:
    changes, message = REFUSED[what]
    with pytest.raises((SpecError, RuntimeError), match=message):
        trainer(tmp_path, folders, **changes)


def test_a_trainer_is_given_what_trains_a_reflector(tmp_path: Path, folders: dict[str, str]) -> None:
    args = config(tmp_path, folders)
    args.agent = {**args.agent, "scope": "run"}
    with pytest.raises(SpecError, match="when: start"):
        RetroformerTrainer(torch.nn.Linear(1, 1), args)
    with pytest.raises(SpecError, match="retroformer_delivery"):
        load_policy(args)
    filled = as_retroformer(config(tmp_path, folders, agent={"reasoning": "direct"}))
    assert filled.spec.reflection.params == {"when": "start"} and filled.spec.scope == "run"
    assert filled.train_calls == [PATH] and filled.reward_set.weights == {"reflection_gain": 1.0}


def test_without_an_actor_the_base_model_acts(tmp_path: Path, folders: dict[str, str]) -> None:
    model, _ = load_actor_and_reflector(config(tmp_path, folders, actor_adapter="", adapter=""))
    ids = torch.tensor([[5, 6, 7]])
    with torch.no_grad():
        expected = tiny_model(tiny_tokenizer()).eval()(ids).logits
        for adapter in (ACTOR, TRAINED):
            model.set_adapter(adapter)
            assert torch.equal(model.eval()(ids).logits, expected)
