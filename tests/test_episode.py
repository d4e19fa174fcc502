"""Invariants 7 and 8: many episodes without influence on each other, failures that stay local, replay, budgets."""

from __future__ import annotations

import dataclasses

import pytest

from agentspec.episode import Job, Runner, make_env
from agentspec.llm.base import ContextOverflowError, LLMError
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory, read_trajectories, replay, write_trajectories
from agentspec.types import Task
from tests.toy_env import TOY

SPECS = [
    {"reasoning": "direct"},
    {"reasoning": "direct", "layout": "snapshot", "memory": {"name": "base", "window": 2}},
    {"reasoning": "cot"},
    {"reasoning": "react"},
    {"reasoning": "react", "layout": "snapshot"},
]


def trader(request) -> str:
    """Sells when the price of the current observation is 5 or more."""
    users = [m.text for m in request.messages if m.role == "user" and "The price is" in m.text]
    price = int(users[-1].rsplit("The price is ", 1)[1][0])
    if request.sampling.choices:
        return "sell now" if price >= 5 else "wait a step"
    if request.tag.purpose == "think":
        return f"The price is {price}."
    return f"Thought: {price}.\nAction: {'SELL' if price >= 5 else 'WAIT'}()"


def direct_trader(request) -> str:
    return trader(request).rsplit("Action: ", 1)[-1]


def run(spec: dict, tasks: list[Task], **kwargs) -> list[Trajectory]:
    script = direct_trader if spec["reasoning"] == "direct" else trader
    return Runner(AgentSpec.from_data(spec), ScriptedLLM(script), **kwargs).run([Job(t) for t in tasks])


def timeless(trajectory: Trajectory) -> str:
    calls = tuple(dataclasses.replace(c, latency_s=0.0) for c in trajectory.calls)
    metrics = {k: v for k, v in trajectory.metrics.items() if k != "thinking_s"}
    return dataclasses.replace(trajectory, calls=calls, metrics=metrics).to_json()


@pytest.mark.parametrize("menu", [False, True])
@pytest.mark.parametrize("spec", SPECS, ids=lambda s: f"{s['reasoning']}-{s.get('layout', 'conversation')}")
def test_result_does_not_depend_on_concurrency(spec: dict, menu: bool) -> None:
    tasks = [Task(TOY, seed, {"menu": menu}) for seed in range(6)]
    alone = [timeless(t) for t in run(spec, tasks, concurrency=1)]
    together = [timeless(t) for t in run(spec, tasks)]
    assert alone == together
    for line in together:
        trajectory = Trajectory.from_json(line)
        assert trajectory.metrics["invalid_actions"] == 0
        # The script earns every price of 5 or more and nothing else.
        prices = [t.input.state["price"] for t in trajectory.transitions]
        assert trajectory.metrics["net_earnings"] == sum(p for p in prices if p >= 5)


@pytest.mark.parametrize("spec", SPECS, ids=lambda s: f"{s['reasoning']}-{s.get('layout', 'conversation')}")
def test_replay_gives_the_same_episode(spec: dict, tmp_path) -> None:
    trajectories = run(spec, [Task(TOY, s) for s in range(3)])
    write_trajectories(tmp_path / "t.jsonl", trajectories)
    read = list(read_trajectories(tmp_path / "t.jsonl"))
    assert [t.to_json() for t in read] == [t.to_json() for t in trajectories]
    assert [t.calls for t in read] == [t.calls for t in trajectories]
    for trajectory in read:
        assert replay(trajectory, make_env) == []
    forged = dataclasses.replace(
        read[0], transitions=(dataclasses.replace(read[0].transitions[0], reward=99.0), *read[0].transitions[1:])
    )
    assert any("reward" in line for line in replay(forged, make_env))


def test_conversation_prompts_extend_each_other() -> None:
    (trajectory,) = run({"reasoning": "direct"}, [Task(TOY, 0)])
    for before, after in zip(trajectory.calls, trajectory.calls[1:], strict=False):
        whole = before.prompt_ids + before.completions[0].token_ids
        assert after.prompt_ids[: len(whole)] == whole


@pytest.mark.parametrize(("fault", "message"), [("crash", "the toy broke"), ("hang", "longer than"), ("nan", "finite")])
def test_a_failing_environment_fails_its_own_episode_only(fault: str, message: str) -> None:
    tasks = [Task(TOY, 0), Task(TOY, 1, {"fault": fault}), Task(TOY, 2)]
    healthy = run({"reasoning": "direct"}, [tasks[0], tasks[2]])
    mixed = run({"reasoning": "direct"}, tasks, timeout_s=3.0 if fault == "hang" else 60.0)
    assert [t.status for t in mixed] == ["completed", "failed", "completed"]
    assert message in mixed[1].error and not mixed[1].scorable
    assert [timeless(mixed[0]), timeless(mixed[2])] == [timeless(t) for t in healthy]


def test_a_failing_model_fails_the_episode() -> None:
    def broken(request) -> str:
        raise LLMError("no answer from the model")

    (trajectory,) = Runner(AgentSpec(), ScriptedLLM(broken)).run([Job(Task(TOY, 0))])
    assert trajectory.status == "failed" and "no answer" in trajectory.error


def test_an_exhausted_budget_ends_the_episode_flagged() -> None:
    spec = {"reasoning": "direct", "budget": {"calls": 2}}
    (trajectory,) = run(spec, [Task(TOY, 0)])
    assert trajectory.status == "completed" and trajectory.metrics["ended"] == "budget"
    assert len(trajectory.transitions) == 2 == trajectory.metrics["llm_calls"]


def test_malformed_answers_are_steps_with_an_error() -> None:
    spec = AgentSpec.from_data({"reasoning": "direct"})
    (trajectory,) = Runner(spec, ScriptedLLM(lambda r: "hm?")).run([Job(Task(TOY, 0))])
    assert trajectory.metrics["invalid_actions"] == 5 == len(trajectory.transitions)
    assert all("is not an action" in t.info["error"] for t in trajectory.transitions)


def test_unknown_environment_names_the_nearest() -> None:
    with pytest.raises(SpecError, match="did you mean deliverybench"):
        make_env(Task("delivrybench"))


def test_rollouts_of_one_task_have_their_own_seeds() -> None:
    jobs = [Job(Task(TOY, 0), rollout=i, run_seed=3) for i in range(4)]
    assert len({j.seed for j in jobs}) == 4
    assert jobs[1].seed == Job(Task(TOY, 0), rollout=1, run_seed=3).seed


def test_thinking_can_cost_simulated_time() -> None:
    options = {"size": "tiny", "action_mode": "menu", "observation": "compact", "max_steps": 3, "shift_hours": 0.3}
    choose = ScriptedLLM(lambda request: request.sampling.choices[0])
    left = []
    for think_time in ("paused", {"call": 60.0, "token": 0.0}):
        task = Task("deliverybench", 0, {**options, "think_time": think_time})
        (trajectory,) = Runner(AgentSpec(), choose).run([Job(task)])
        assert trajectory.status == "completed", trajectory.error
        assert replay(trajectory, make_env) == []
        left.append(trajectory.transitions[2].input.state["left_s"])
    # Two decisions of one call each: two minutes of the shift, on top of what the actions took.
    assert left[0] - left[1] >= 120.0


@pytest.mark.parametrize(
    ("a", "b", "length"), [((), (1,), 0), ((1, 2, 3), (1, 2, 3), 3), ((1, 2, 3), (1, 2, 4, 5), 2), ((2,), (1,), 0)]
)
def test_shared_prefix(a: tuple[int, ...], b: tuple[int, ...], length: int) -> None:
    from agentspec.tokens import shared_prefix

    assert shared_prefix(a, b) == length == shared_prefix(b, a)


@pytest.mark.parametrize("fault", ["model", "context"])
def test_a_reflection_that_fails_touches_its_own_episode_only(fault: str) -> None:
    """The model may fail, or the trial be too long, when the episode has already ended."""

    def script(request) -> str:
        if request.tag.purpose != "reflect":
            return "WAIT()"
        if request.seed % 2:
            return "Sell when the price is high."
        if fault == "model":
            raise LLMError("no answer from the model")
        raise ContextOverflowError("the trial is too long")

    spec = AgentSpec.from_data(
        {"reasoning": "direct", "reflection": {"name": "reflexion", "threshold": 100.0}, "scope": "run"}
    )
    played = Runner(spec, ScriptedLLM(script)).run([Job(Task(TOY, seed)) for seed in range(12)])
    wrote = [any(c.tag.purpose == "reflect" for c in t.calls) for t in played]
    assert any(wrote) and not all(wrote)
    for trajectory, lesson in zip(played, wrote, strict=True):
        assert trajectory.scorable == (lesson or fault == "context")
        assert bool(trajectory.error) == (not lesson and fault == "model")
        # A trial that is too long to be reflected on: nothing is learnt, and the metrics say so.
        assert trajectory.metrics.get("reflection/problems/overflow", 0) == int(not lesson and fault == "context")
        assert trajectory.transitions
