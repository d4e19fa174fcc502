"""SUPO as a configuration: the summary schedule, overlong episodes, and whose advantage a summary's tokens get."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.records.log import RunLog
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from recipes.common import CONFIGS
from tests.toy_env import TOY
from tests.trainers.builders import call, episode
from tests.trainers.played import toy_trainer
from trainers.arguments import parse_config
from trainers.audit import audit
from trainers.call_metrics import truncated_calls
from trainers.config import ScaffoldConfig
from trainers.credit import Credited, is_overlong
from trainers.presets import as_supo
from trainers.sequences import build_sequences

SUPO = {
    "agent": {"reasoning": "direct", "memory": {"name": "summary", "every": 3}},
    "train_calls": ["reasoning.*", "memory.summary"],
}


def configured(tmp_path: Path, **changes: Any) -> ScaffoldConfig:
    settings = {"output_dir": str(tmp_path), "use_cpu": True, "bf16": False, "num_generations": 4, **changes}
    return ScaffoldConfig(per_device_train_batch_size=4, report_to=[], **settings)


def credited(episodes: Sequence[Trajectory], config: ScaffoldConfig) -> Credited:
    rule = config.credit_rule
    return rule.credit(rule.score(episodes))


# --- the configuration -----------------------------------------------------------------------------------------------


def test_a_plain_configuration_becomes_supo(tmp_path: Path) -> None:
    config = as_supo(configured(tmp_path, agent={"reasoning": "react"}))
    config.check()
    assert config.spec.memory.name == "summary" and config.spec.memory.params == {"every": 8}
    assert config.train_calls == ["reasoning.*", "memory.summary"]
    assert config.mask_truncated == ["memory.summary"] and config.overlong == "mask"
    # Once more changes nothing.
    again = as_supo(config)
    assert again.train_calls == ["reasoning.*", "memory.summary"] and again.spec.memory.params == {"every": 8}


def test_what_is_configured_stays(tmp_path: Path) -> None:
    agent = {"reasoning": "direct", "memory": {"name": "summary", "every": 3}}
    calls = ["reasoning.*", "memory.summary/summary"]
    config = as_supo(configured(tmp_path, agent=agent, train_calls=calls, mask_truncated=["memory.*"]))
    assert config.spec.memory.params == {"every": 3}
    assert config.train_calls == calls and config.mask_truncated == ["memory.*"]


@pytest.mark.parametrize(
    ("agent", "message"),
    [({"memory": "base"}, "memory is 'base'; set `memory: summary`"), ({"layout": "snapshot"}, "set `layout: conv")],
)
def test_what_is_not_supo_is_refused(tmp_path: Path, agent: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        as_supo(configured(tmp_path, agent={"reasoning": "direct", **agent}))


def test_the_recipe_s_configuration_is_supo() -> None:
    config = parse_config([], default=CONFIGS / "supo_cpu.yaml")
    config.check()
    before = (config.spec.to_data(), list(config.train_calls), list(config.mask_truncated))
    as_supo(config)
    assert (config.spec.to_data(), config.train_calls, config.mask_truncated) == before
    assert config.spec.memory.params["every"] == 8 and config.overlong == "mask"  # AgentSpec's K; the paper's option
    # A policy is evaluated in the contexts it was trained in.
    memory = config.spec.memory
    assert any(AgentSpec.from_data(s).memory == memory for s in config.evaluation_specs)


# --- overlong episodes -----------------------------------------------------------------------------------------------

RETURNS = [15.0, 10.0, 5.0, 15.0]


def ended(how: str, i: int, *, truncated: bool = False) -> Trajectory:
    """Two segments, the return of rollout ``i``."""
    built = episode([call(0, [1, i], [2, 3]), call(1, [4, i], [5])], [RETURNS[i]], rollout=i)
    last = replace(built.transitions[-1], truncated=truncated)
    return replace(built, metrics={"ended": how}, transitions=(*built.transitions[:-1], last))


@pytest.mark.parametrize(
    ("overlong", "expected"),
    [
        # Mean 11.25, sample deviation 4.787 + 1e-4, as if nothing were overlong; the second rollout has no loss.
        ("mask", [0.783, None, -1.306, 0.783]),
        ("keep", [0.783, -0.261, -1.306, 0.783]),
        # Without the second: mean 11.667, deviation 5.774.
        ("drop", [0.577, None, -1.155, 0.577]),
    ],
)
def test_overlong_episodes(tmp_path: Path, overlong: str, expected: list[float | None]) -> None:
    episodes = [ended("context" if i == 1 else "environment", i) for i in range(4)]
    config = configured(tmp_path, overlong=overlong)
    result = credited(episodes, config)
    assert result.metrics["rollouts/overlong"] == 0.25
    got: dict[int, set[float]] = {}
    for row in result.rows:
        got.setdefault(row.episode, set()).add(round(row.advantage, 3))  # type: ignore[arg-type]
    # One advantage for both segments of a rollout.
    assert got == {i: {a} for i, a in enumerate(expected) if a is not None}
    assert len(result.rows) == 2 * len(got)


def test_an_overlong_episode_without_loss_is_no_failure(tmp_path: Path) -> None:
    """Overlong counts as overlong, failed as unscorable: not both."""
    episodes = [ended("context", 0), replace(ended("failure", 1), status="failed"), ended("environment", 2)]
    result = credited([*episodes, ended("environment", 3)], configured(tmp_path))
    assert result.metrics["rollouts/overlong"] == 0.25 and result.metrics["rollouts/unscorable"] == 0.25
    assert {r.episode for r in result.rows} == {2, 3}


def test_which_ends_are_overlong() -> None:
    # An agent that stops early, and a shift that is over, are not overlong; only what `overlong_ends` names is.
    assert is_overlong(ended("context", 0), ["context"])
    assert not is_overlong(ended("environment", 0), ["context"])
    assert not is_overlong(ended("environment", 0, truncated=True), ["context"])
    assert is_overlong(ended("environment", 0, truncated=True), ["context", "truncated"])
    assert not is_overlong(ended("max_steps", 0), ["context"]) and is_overlong(ended("budget", 0), ["budget"])


# --- summaries -------------------------------------------------------------------------------------------------------


def played(
    steps: int = 7, *, summary: str = "note", spec: dict[str, Any] | None = None, **llm: Any
) -> list[Trajectory]:
    """Two rollouts of one task: the first sells at every step, the second waits."""

    def script(request: Request) -> str:
        if request.tag.purpose == "summary":
            return summary
        return "SELL()" if request.tag.episode.split("-")[-2] == "0" else "WAIT()"

    agent = {"reasoning": "direct", "memory": {"name": "summary", "every": 3}} if spec is None else spec
    task = Task(TOY, 0, {"steps": steps})
    return Runner(AgentSpec.from_data(agent), ScriptedLLM(script, **llm)).run([Job(task, 0), Job(task, 1)])


def test_summary_tokens_get_the_advantage_of_their_rollout(tmp_path: Path) -> None:
    episodes = played()
    config = configured(tmp_path, num_generations=2, **SUPO)
    result = credited(episodes, config)
    # 7 actions, summaries after the 3rd and the 6th: three segments each.
    assert [r.episode for r in result.rows] == [0, 0, 0, 1, 1, 1]
    # Two rollouts: deviation |a - b| / sqrt 2, so the advantages are +-0.707.
    assert [round(r.advantage, 3) for r in result.rows] == [0.707] * 3 + [-0.707] * 3  # type: ignore[arg-type]
    for t, rows in ((t, [r for r in result.rows if r.episode == i]) for i, t in enumerate(episodes)):
        summaries = {c.id: c for c in t.calls if c.tag.purpose == "summary"}
        assert len(summaries) == 2
        for row in rows[:2]:
            owner = row.sequence.calls[-1]
            tokens = summaries[owner].completions[0].token_ids
            assert tuple(row.sequence.tokens[-len(tokens) :]) == tokens
            assert row.sequence.mask[-len(tokens) :] == [1] * len(tokens)


def test_a_summary_in_the_next_prompt_is_context(tmp_path: Path) -> None:
    """It is written again as text: its tokens there are nobody's choice and carry no log-probability."""
    (first, _) = played(summary="remember the price")
    rows = build_sequences(first, configured(tmp_path, **SUPO).train_filter)
    carried = list(b"remember the price")
    for row in rows[1:]:
        start = next(i for i in range(len(row)) if row.tokens[i : i + len(carried)] == carried)
        place = slice(start, start + len(carried))
        assert row.mask[place] == [0] * len(carried) and row.logprobs[place] == [0.0] * len(carried)
        assert set(row.calls[place]) == {-1}


def test_truncated_summaries_are_counted_and_masked(tmp_path: Path) -> None:
    spec = {"reasoning": "direct", "memory": {"name": "summary", "every": 3, "summary_tokens": 5}}
    episodes = played(summary="much too long", spec=spec)
    masked = configured(tmp_path, num_generations=2, mask_truncated=["memory.summary"], **SUPO)
    kept = configured(tmp_path, num_generations=2, **SUPO)
    counts = []
    for config in (masked, kept):
        result = credited(episodes, config)
        assert truncated_calls(episodes, config.train_filter)["calls/memory.summary/summary/truncated"] == 1.0
        assert truncated_calls(episodes, config.train_filter)["calls/reasoning.direct/act/truncated"] == 0.0
        counts.append(result.metrics["rollouts/trained_tokens"])
    assert counts[1] - counts[0] == 2 * 2 * 5  # two episodes, two summaries of five tokens


def test_an_episode_that_runs_out_of_context_after_a_summary_is_overlong(tmp_path: Path) -> None:
    """Whatever the estimator: the summary's last segment is rolled back neither in the record nor in the baseline."""
    memory = {"name": "summary", "every": 2, "max_summaries": 1}
    spec = {"reasoning": "direct", "memory": memory, "sampling": {"max_tokens": 256}}
    whole = played(spec=spec)
    acts = [len(c.prompt_ids) for c in whole[0].calls if c.tag.purpose == "act"]
    # Room for the acts of the first segment and the summary, not for the whole second segment.
    summary = next(c for c in whole[0].calls if c.tag.purpose == "summary")
    limit = max(len(summary.prompt_ids) + 192, acts[1] + 256)
    episodes = played(steps=60, spec=spec, max_context=limit)
    assert all(t.metrics["ended"] == "context" and t.scorable for t in episodes)
    assert all(any(c.tag.purpose == "summary" for c in t.calls) for t in episodes)
    for estimator in ("grpo", "reward_to_go"):
        for overlong, rows in (("mask", 0), ("drop", 0), ("keep", 4)):
            config = configured(tmp_path, num_generations=2, overlong=overlong, estimator=estimator, **SUPO)
            result = credited(episodes, config)
            assert len(result.rows) == rows and result.metrics["rollouts/overlong"] == 1.0


def test_supo_trains(tmp_path: Path) -> None:
    changes: dict[str, Any] = {
        "agent": {
            "reasoning": "direct",
            "memory": {"name": "summary", "every": 1, "summary_tokens": 6},
            "sampling": {"max_tokens": 8},
        },
        "train_calls": ["reasoning.*", "memory.summary"],
    }
    toy_trainer(tmp_path, max_steps=1, **changes).train()
    (receipt,) = audit(tmp_path)
    assert receipt.violations == []
    # Three actions, a summary after the first and the second: three segments per episode.
    assert receipt.rows == 3 * receipt.episodes
    assert receipt.by_tag["memory.summary/summary"] == receipt.episodes * 2 * 6
    (metrics,) = RunLog(tmp_path).read("metrics.jsonl")
    assert metrics["calls/memory.summary/summary/truncated"] == 1.0  # random text never ends by itself
    assert metrics["rollouts/multi_row_episodes"] == 1.0
    assert metrics["sampling/logp_difference_max"] < 1e-4  # invariant 1, over all segments
