"""Efficiency, goal conditions and geodesic progress: exact values, and the worlds' own rewards as a second opinion."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agentspec.episode import Job, Runner
from agentspec.spec import AgentSpec
from agentspec.types import Task
from rewards import RewardSet
from tests.trainers.builders import episode


def told(*reports, **metrics):
    """An episode whose steps report this, and what it came to."""
    played = episode([], rewards=[0.0] * len(reports))
    steps = tuple(replace(t, info={**t.info, **report}) for t, report in zip(played.transitions, reports, strict=True))
    return replace(played, transitions=steps, metrics=metrics)


def paid(name, played):
    return RewardSet({name: 1.0}).score(played).terms[name]


def played(env, options, seed=0, policy="rule_based"):
    return Runner(AgentSpec.from_data({"reasoning": policy})).run([Job(Task(env, seed, options))])[0]


def test_efficiency_is_paid_at_the_end_under_either_name():
    assert paid("efficiency", told({}, {}, efficiency=0.25)) == (0.0, 0.25)
    assert paid("efficiency", told({}, {}, spl=0.5)) == (0.0, 0.5)
    assert paid("efficiency", told({}, {}, efficiency=None)) == (0.0, 0.0)  # cut short
    with pytest.raises(ValueError, match="toy reports neither"):
        paid("efficiency", told({}, {}))


def test_goal_progress_pays_changes_and_takes_back_what_is_undone():
    shares = [0.0, 0.5, 0.5, 0.0, 1.0]
    rewards = paid("goal_progress", told(*({"goal_conditions": s} for s in shares)))
    assert rewards == (0.0, 0.5, 0.0, -0.5, 1.0)
    assert sum(rewards) == shares[-1]
    assert paid("goal_progress", told({"goal_conditions": 0.5}, {"goal_conditions": 0.5})) == (0.5, 0.0)
    with pytest.raises(ValueError, match=r"goal_progress` needs info\['goal_conditions'\]"):
        paid("goal_progress", told({}))


def test_geodesic_progress_is_clipped_by_what_was_walked():
    def report(walked, left):
        return {"geodesic": {"walked": walked, "left": left, "start": 4.0, "shortest": 2.0}}

    rewards = paid(
        "geodesic_progress",
        told(
            report(0.25, 3.75),  # 0.25 m nearer, all of it walked: 0.25 / 2
            report(0.25, 3.75),  # turned: 0
            report(0.5, 3.0),  # 0.75 m nearer by the map, 0.25 m walked: 0.25 / 2
            report(0.75, 3.5),  # 0.5 m farther by the map: no farther than what was paid for
            report(1.0, None),  # off the known floor
            report(1.25, 3.0),  # and back: the part of the jump that was walked meanwhile
        ),
    )
    assert rewards == (0.125, 0.0, 0.125, 0.0, 0.0, 0.125)
    circle = [
        report(0.25 * n, left) for n, left in enumerate((3.75, 4.25, 4.0) * 40, 1)
    ]  # jumps 0.5 m every third step
    assert sum(paid("geodesic_progress", told(*circle))) <= 0.25 / 2  # never more than it has come nearer
    short = {"walked": 0.25, "left": 0.25, "start": 0.5, "shortest": 0.5}
    assert paid("geodesic_progress", told({"geodesic": short})) == (0.25,)  # over one metre, not over half a metre
    with pytest.raises(ValueError, match=r"needs info\['geodesic'\] at every step"):
        paid("geodesic_progress", told({}))


@pytest.mark.parametrize("policy", ["rule_based", "random"])
def test_robothors_own_progress_is_the_same_plus_success(policy):
    found = played("robothor", {"reward": "progress", "max_steps": 40}, policy=policy)
    progress, success = paid("geodesic_progress", found), paid("success", found)
    assert [t.reward for t in found.transitions] == pytest.approx(
        [a + b for a, b in zip(progress, success, strict=True)]
    )
    if policy == "rule_based":
        # Stops at 1.5 m with the target in view, so the whole way to where it is seen was walked.
        assert sum(success) == 1.0 and sum(progress) > 0 and paid("efficiency", found)[-1] == found.metrics["spl"] > 0.9


def test_alfreds_own_reward_is_goal_progress():
    found = played("alfred", {"action_mode": "menu"})
    assert found.metrics["success"] == 1.0
    assert paid("goal_progress", found) == pytest.approx([t.reward for t in found.transitions])


def test_minigrid_pays_efficiency():
    pytest.importorskip("minigrid")
    found = played("minigrid", {"task": "fetch_5x5_n2_seed99"})
    assert paid("efficiency", found) == (0.0,) * 4 + (1.0,)
