"""What a write to memory earns: plans, exact credit, exact re-rolls, and what the audit says of them."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.replayed import ReplayedLLM
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import REGISTRY, SpecError
from agentspec.spec import AgentSpec
from agentspec.types import Task
from rewards import RewardSet
from tests.fixtures import trial_memories
from tests.memory.recall_world import RECALL, Reader
from tests.toy_env import TOY
from tests.trainers.builders import call, episode
from tests.trainers.played import toy_trainer
from trainers.audit import audit
from trainers.counterfactuals import FOLDER, attach, differences, play_beside, records
from trainers.credit import CreditRule, Outcome, ScoredEpisode
from trainers.estimators import centred, grpo
from trainers.sequences import TrainFilter
from trainers.writes import EVERY, WRITE_CREDITS, Paired, Plan, WriteReturn, WriteRule, ablation, local

ALL = TrainFilter(("*",), ("executed", "aux"))
WRITE = {"module": "memory.m", "purpose": "curate", "credit": "aux"}


@pytest.fixture(autouse=True)
def trials() -> Iterator[None]:
    names = REGISTRY.add_module(trial_memories)
    yield
    for name in names:
        REGISTRY.unregister("memory", name)


def returns(step: int, with_it: list[float | None], without: list[float | None]) -> tuple[WriteReturn, ...]:
    pairs = ((True, with_it), (False, without))
    return tuple(WriteReturn(Plan(step, kept, i), r) for kept, rs in pairs for i, r in enumerate(rs))


# --- the numbers -----------------------------------------------------------------------------------------------------


def test_a_local_write_earns_the_difference_of_its_two_groups() -> None:
    one = Paired(0.0, returns(3, [3.0, 1.0], [1.0, 1.0]))
    # One group of 3, 1, 1, 1: mean 1.5, so 1.5, -.5, -.5, -.5; with the write .5 on average, without -.5.
    assert local([one], centred) == [{3: 1.0}]
    # Sample deviation: sqrt((2.25 + 3 x .25) / 3) = 1: the same, divided by 1.0001.
    assert local([one], grpo)[0][3] == pytest.approx(1 / 1.0001, abs=1e-12)
    # A re-roll that failed counts nowhere: 3 against 1, 1: mean 5/3, 4/3 less -2/3. Without any left: nothing.
    assert local([Paired(0.0, returns(3, [3.0, None], [1.0, 1.0]))], centred)[0][3] == pytest.approx(2.0)
    assert local([Paired(0.0, returns(3, [None, None], [1.0, 1.0]))], centred) == [{3: 0.0}]
    # Two writes are two comparisons; an episode without re-rolls has none.
    both = Paired(0.0, (*returns(2, [1.0], [0.0]), *returns(5, [0.0], [1.0])))
    assert local([both, Paired(9.0)], centred) == [{2: 1.0, 5: -1.0}, {}]


def test_an_ablated_memory_earns_the_difference_of_pairs_in_one_group() -> None:
    def twin(value: float | None) -> tuple[WriteReturn, ...]:
        return (WriteReturn(Plan(EVERY, kept=False), value),)

    # With memory 3 and 1, without 1 and 1: centring cancels in the pair, 3 - 1 and 1 - 1; `grpo` divides by 1.0001.
    group = [Paired(3.0, twin(1.0)), Paired(1.0, twin(1.0))]
    assert ablation(group, centred) == [{EVERY: 2.0}, {EVERY: 0.0}]
    assert [a[EVERY] for a in ablation(group, grpo)] == pytest.approx([2 / 1.0001, 0.0])
    # An episode or a twin that failed takes its pair out: 3 and 1 of the first are the whole group.
    assert ablation([group[0], Paired(None, twin(1.0)), Paired(2.0, twin(None)), Paired(2.0)], centred) == [
        {EVERY: 2.0},
        {},
        {},
        {},
    ]
    # Leave-one-out scales by n / (n - 1) = 4 / 3, as the run's estimator does everywhere else.
    rule = CreditRule(group=2, estimator="rloo", writes=WriteRule("ablation"))
    outcomes = [Outcome((3.0,), beside=twin(1.0)), Outcome((1.0,), beside=twin(1.0))]
    assert [w[EVERY] for w in rule.write_advantages(outcomes) if w] == pytest.approx([8 / 3, 0.0])
    assert CreditRule(group=2).write_advantages(outcomes) == [None, None]


def test_tokens_of_a_write_earn_what_the_write_does() -> None:
    calls = [
        call(0, [1], [2]),
        call(1, [1, 9], [3], step=1, **WRITE),
        call(2, [1, 2, 4], [5], step=1),
        call(3, [1, 9, 9], [6], step=2, **WRITE),
        call(4, [1, 2, 4, 5, 7], [8], step=2),
    ]
    first, second = episode(calls, [1.0, 0.0, 2.0]), episode(calls, [0.0, 0.0, 1.0], rollout=1)
    rule = CreditRule(
        group=2, estimator="centred", train=ALL, rewards={"env": 1.0}, writes=WriteRule("local", rerolls=1)
    )
    beside = {3: (3.0, 1.0), 1: (0.0, 0.0)}
    scored = []
    for e, (with_it, without) in zip(rule.score([first, second]), beside.values(), strict=True):
        others = [(p, ScoredEpisode(e.trajectory, score([0.0, v, 0.0]))) for p, v in plans(1, with_it, without)]
        scored.append(replace(e, beside=tuple(others)))
    rows = rule.credit(scored).rows
    # Returns 3 and 1: actions earn +1 and -1. The write of step 1 of the first: 3 against 1, so 2; of the second 0.
    # The write of step 2 was not looked at: 0.
    earned = {(r.episode, r.sequence.tokens[-1]): r.advantage for r in rows}
    assert earned == {
        (0, 8): 1.0,
        (0, 3): (0.0, 0.0, 2.0),
        (1, 8): -1.0,
        (1, 3): (0.0, 0.0, 0.0),
    } | {(e, 6): (0.0, 0.0, 0.0, 0.0) for e in (0, 1)}


def plans(step: int, *values: float) -> list[tuple[Plan, float]]:
    return [(Plan(step, kept), v) for kept, v in zip((True, False), values, strict=True)]


def score(steps: list[float]) -> Any:
    return RewardSet({"env": 1.0}).score(episode([], steps))


def test_which_writes_are_looked_at_hangs_on_the_episode_alone() -> None:
    calls = [call(s, [s], [9], step=s, **WRITE) for s in range(1, 6)]  # after the last step it earns nothing
    played = replace(episode(calls, [0.0] * 5), seed=11)
    rule = WriteRule("local", rerolls=2, points=2)
    assert rule.steps(played, ALL) == [1, 2, 3, 4]
    plan = rule.plan(played, ALL)
    steps = sorted({p.step for p in plan})
    assert len(steps) == 2 and set(steps) <= {1, 2, 3, 4}
    assert plan == [Plan(s, kept, i) for s in steps for kept in (True, False) for i in range(2)]
    assert plan == rule.plan(replace(played, metrics={"x": 1}), ALL)
    drawn = [rule.plan(replace(played, seed=seed), ALL)[0].step for seed in range(40)]
    assert set(drawn) == {1, 2, 3}  # the first of two of four: any but the last
    assert WriteRule("ablation").plan(played, ALL) == [Plan(EVERY, kept=False)]
    # No write that is trained, an episode that failed, credit by the episode: nothing is played.
    assert not rule.plan(played, TrainFilter()) and not WriteRule().plan(played, ALL)
    assert not rule.plan(replace(played, status="failed"), ALL)
    assert len(rule.plan(replace(played, transitions=played.transitions[:2]), ALL)) == 4  # step 1 is all there is


# --- re-rolls --------------------------------------------------------------------------------------------------------


def write_rule(credit: str, **more: Any) -> CreditRule:
    settings = {"group": 2, "estimator": "centred", "train": ALL, "rewards": {"env": 1.0}, **more}
    return CreditRule(writes=WriteRule(credit, points=9), **settings)


def played(llm: Any, env: str, options: dict[str, Any], rule: CreditRule, **spec: Any) -> list[ScoredEpisode]:
    data = {"memory": "cheat_sheet", "layout": "snapshot", "embedder": "hash", **spec}
    runner, jobs = Runner(AgentSpec.from_data(data), llm), [Job(Task(env, 0, options), r) for r in (0, 1)]
    return play_beside(runner, jobs, rule.score(runner.run(jobs)), rule)


def test_the_write_that_keeps_the_fact_earns_what_the_question_pays() -> None:
    rule = write_rule("local")
    episodes = played(Reader(), RECALL, {"delay": 3}, rule)
    # Notice at step 0, question at step 3; the sheet is written after every step. The write of step 1 has the notice
    # before it: without it nothing else ever shows the fact. Those of steps 2 and 3 only add a sight to the sheet.
    assert [e.total for e in episodes] == [1.0, 1.0]
    outcomes = [rule.outcome(e) for e in episodes]
    assert rule.write_advantages(outcomes) == [{1: 1.0, 2: 0.0, 3: 0.0}] * 2
    totals = {(r.plan.step, r.plan.kept): r.total for r in outcomes[0].beside}
    assert totals == {(1, True): 1.0, (1, False): 0.0} | {(s, k): 1.0 for s in (2, 3) for k in (True, False)}


def test_a_memory_is_worth_what_it_earns_over_none() -> None:
    rule = write_rule("ablation")
    episodes = played(Reader(), RECALL, {"delay": 3}, rule)
    assert [[o.total for _, o in e.beside] for e in episodes] == [[0.0], [0.0]]
    assert rule.write_advantages([rule.outcome(e) for e in episodes]) == [{EVERY: 1.0}] * 2
    (_, twin), *_ = episodes[0].beside
    assert {c.tag.module for c in twin.trajectory.calls} == {"reasoning.direct"}


def test_a_kept_write_repeats_the_episode_where_the_model_does() -> None:
    rule = write_rule("local")
    for e in played(Reader(), RECALL, {"delay": 3}, rule, scope="run"):
        for plan, other in e.beside:
            same = [t.action_text for t in other.trajectory.transitions] == [
                t.action_text for t in e.trajectory.transitions
            ]
            assert same == (plan.kept or plan.step > 1)
            if plan.kept:  # the whole state is the same, memory, time and ids among it
                assert other.trajectory.memory_state == e.trajectory.memory_state


def gambler(request: Request) -> str:
    """Acts by the seed of its request, and writes what nobody reads."""
    return '{"sheet": ""}' if request.tag.purpose == "curate" else ("SELL()", "WAIT()")[request.seed % 2]


def test_a_write_that_changes_no_prompt_earns_exactly_nothing() -> None:
    rule = write_rule("local")
    episodes = played(ScriptedLLM(gambler), TOY, {"steps": 4}, rule)
    for e in episodes:
        totals = [o.rest(p.step) for p, o in e.beside]
        assert len(set(totals)) > 1  # chance decides, but not whether there was a write
        pairs = {(p.step, p.number): o.total for p, o in e.beside if p.kept}
        assert pairs == {(p.step, p.number): o.total for p, o in e.beside if not p.kept}
    advantages = rule.write_advantages([rule.outcome(e) for e in episodes])
    assert advantages == [{1: 0.0, 2: 0.0, 3: 0.0}] * 2


def test_re_rolls_begin_as_their_episode_began(monkeypatch: pytest.MonkeyPatch) -> None:
    rule = write_rule("local")
    first, _ = episodes = played(ScriptedLLM(gambler), TOY, {"steps": 4}, rule)
    beside = records(episodes)
    assert attach(rule.score([e.trajectory for e in episodes]), beside, rule) == episodes
    (plan, other), *_ = [(p, o.trajectory) for p, o in first.beside if p.step == 3 and not p.kept]
    assert list(differences(first.trajectory, other, plan, rule)) == []
    step = replace(other.transitions[0], reward=99.0)
    late = [c for c in first.trajectory.calls if c.tag.step == 3 and c.tag.purpose == "curate"]
    for forged, message in (
        (replace(other, seed=1), "it is of"),
        (replace(other, policy="step-9"), "played by policy step-9"),
        (replace(other, metrics={}), "its plan is not"),
        (replace(other, transitions=(step, *other.transitions[1:])), "its steps before the write"),
        (replace(other, calls=other.calls[1:]), "its calls before the write"),
        (replace(other, calls=(*other.calls, *late)), "the write was to be withheld"),
    ):
        assert message in " ".join(differences(first.trajectory, forged, plan, rule))
    problems: list[str] = []
    attach(rule.score([e.trajectory for e in episodes]), beside[:-1], rule, problems)
    assert problems == [f"{episodes[1].trajectory.episode} has 11 counterfactuals, expected 12"]
    problems = []
    attach(rule.score([e.trajectory for e in episodes]), [*beside, beside[0]], rule, problems)
    assert problems == ["1 counterfactuals belong to no write"]
    with pytest.raises(ValueError, match="11 counterfactuals, expected 12"):
        attach(rule.score([e.trajectory for e in episodes]), beside[:-1], rule)


def test_an_episode_that_cannot_be_repeated_has_no_re_rolls_that_count() -> None:
    count = iter(range(10_000))

    memory = trial_memories.CheatSheet
    before = memory.store

    async def store(self: Any, transition: Any) -> None:
        if next(count) >= 8:  # two episodes of four steps are over: from now on it asks for something else, too
            await self.services.ask("other", "?", 8)
        await before(self, transition)

    memory.store = store  # type: ignore[method-assign]
    try:
        rule = write_rule("local")
        episodes = played(Reader(curate={"other": "x"}), RECALL, {"delay": 3}, rule)
    finally:
        memory.store = before  # type: ignore[method-assign]
    late = [o.trajectory for e in episodes for p, o in e.beside if p.step > 1]
    assert late and all(t.status == "failed" and "was not asked when the episode was recorded" in t.error for t in late)
    # The write of step 1 has nothing before it that could differ; the others cannot be compared with anything.
    assert rule.write_advantages([rule.outcome(e) for e in episodes]) == [{1: 1.0, 2: 0.0, 3: 0.0}] * 2


# --- in training -----------------------------------------------------------------------------------------------------

AGENT = {
    "reasoning": "direct",
    "memory": {"name": "tests.fixtures.trial_memories:CheatSheet", "sheet_tokens": 6},
    "layout": "snapshot",
    "sampling": {"max_tokens": 8},
}
MEMORY = {"agent": AGENT, "train_calls": ["reasoning.*", "memory.*"], "train_credits": ["executed", "aux"]}


@pytest.mark.parametrize("estimator", ["grpo", "reward_to_go"])
@pytest.mark.parametrize("credit", WRITE_CREDITS)
def test_three_updates_with_each_estimator_of_a_write_are_audited(tmp_path: Path, credit: str, estimator: str) -> None:
    updates = 3 if estimator == "grpo" else 1
    trainer = toy_trainer(tmp_path, max_steps=updates, write_credit=credit, estimator=estimator, **MEMORY)
    trainer.train()
    findings = list(audit(tmp_path))
    assert [f.violations for f in findings] == [[]] * updates and all(f.trained == f.denominator for f in findings)
    assert all(f.by_tag["memory.cheat_sheet/curate"] > 0 for f in findings)
    logged = trainer.run_log.read("metrics.jsonl")
    folder = tmp_path / FOLDER
    if credit == "episode":
        assert not folder.exists() and "writes/counterfactuals" not in logged[0]
        return
    # Four episodes of three steps: one write of each is re-rolled twice with and twice without; or four twins.
    expected = 16 if credit == "local" else 4
    assert [len(p.read_text().splitlines()) for p in sorted(folder.glob("*.jsonl"))] == [expected] * updates
    assert all(r["writes/counterfactuals"] == expected and r["writes/failed"] == 0 for r in logged)
    # What is edited is named, and a missing file too.
    (first, *_) = sorted(folder.glob("*.jsonl"))
    lines = first.read_text()
    first.write_text(lines.replace('"counterfactual/kept":false', '"counterfactual/kept":true', 1))
    told = [v for f in audit(tmp_path) for v in f.violations]
    assert any(f"{FOLDER}/000000.jsonl" in v and "metrics" in v for v in told)
    assert any("its plan is not" in v for v in told)
    first.unlink()
    assert any("is missing" in v for f in audit(tmp_path) for v in f.violations)


def test_a_resumed_run_plays_the_same_re_rolls(tmp_path: Path) -> None:
    settings = {"write_credit": "local", "save_strategy": "steps", "save_steps": 1, **MEMORY}
    whole = toy_trainer(tmp_path / "whole", max_steps=2, **settings)
    whole.train()
    part = toy_trainer(tmp_path / "part", max_steps=1, **settings)
    part.train()
    again = toy_trainer(tmp_path / "part", max_steps=2, **settings)
    again.train(resume_from_checkpoint=True)
    one, other = (t.run_log.read("updates.jsonl") for t in (whole, again))
    assert [r.pop("chain") for r in one] and [r.pop("chain") for r in other] and one == other


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"write_credit": "locall"}, "unknown write_credit 'locall'"),
        ({"write_credit": "ablation", "train_calls": ["reasoning.*"]}, "is both trained"),
        ({"write_credit": "local", "write_calls": ["memory.*/other"]}, "is both trained"),
        ({"write_rerolls": 3}, "write_rerolls is 3, which changes nothing: set `write_credit: local`"),
        ({"write_credit": "ablation", "write_points": 3}, "write_points is 3, which changes nothing"),
        ({"write_credit": "local", "write_rerolls": 0}, "expected a number of at least 1"),
        ({"write_calls": ["memory.cheat_sheet"]}, "which changes nothing: write_credit is 'episode'"),
    ],
)
def test_what_would_credit_nothing_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        toy_trainer(tmp_path, **{**MEMORY, **changes})


def test_helpers_answers_are_not_played_again(tmp_path: Path) -> None:
    agent = {**AGENT, "roles": {"reasoning.*": {"backend": "openai", "model": "m", "base_url": "http://localhost:1"}}}
    with pytest.raises(SpecError, match="those of helper models are not given back"):
        toy_trainer(tmp_path, **{**MEMORY, "agent": agent, "write_credit": "local", "train_calls": ["memory.*"]})


def test_a_replayed_backend_is_a_whole_backend() -> None:
    live = Reader()
    replayed = ReplayedLLM(live, (), step=1, withheld=lambda request: False, seeds=(0,), suffix="~1")
    assert (replayed.name, replayed.max_context) == (live.name, live.max_context)
    assert replayed.capabilities == live.capabilities and replayed.count_tokens("12345678") == 3
    assert asyncio.run(replayed.score((), ["ab"], episode="e")) == (-2.0,)
