"""What surrounds the modules: when a call was made, who pays for it, and what a module that fails does to a run."""

from __future__ import annotations

import pytest

from agentspec.agent import Agent
from agentspec.episode import Job, Runner, make_env
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.memory.base import BaseMemory
from agentspec.spec import AgentSpec
from agentspec.state import dump_state, load_state
from agentspec.trajectory import Trajectory
from agentspec.types import (
    Action,
    ActionError,
    ActionSchema,
    AgentInput,
    Decision,
    Experience,
    Recall,
    RecallItem,
    Task,
    Transition,
)
from tests.toy_env import TOY


class NoteTaker(BaseMemory):
    """A memory that asks something at every occasion, and may be made to fail at one."""

    fail_at = ""

    async def _ask(self, occasion: str) -> None:
        if occasion == self.fail_at:
            len(3)  # type: ignore[arg-type]  # a TypeError, as from valid JSON of the wrong shape
        await self.services.llm.generate(occasion, self.services.context.messages, max_tokens=20)

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        await self._ask("retrieve")
        return await super().retrieve(input, k)

    async def store(self, transition: Transition) -> None:
        await self._ask("store")
        await super().store(transition)

    async def end_episode(self, trajectory: Trajectory) -> None:
        await self._ask("end")


class Diary(BaseMemory):
    """A memory that tells its steps whatever the conversation holds."""

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        return Recall(tuple(RecallItem(line, source="memory.diary") for line, _ in self._steps))


@pytest.fixture
def build(monkeypatch: pytest.MonkeyPatch):
    """Agents whose memory is a NoteTaker."""
    whole = AgentSpec.build

    def with_notes(self: AgentSpec, recorder, **more) -> Agent:
        agent = whole(self, recorder, **more)
        services = next(s for s in agent.services if s.llm.module.startswith("memory."))
        agent.memory = NoteTaker(services)
        return agent

    monkeypatch.setattr(AgentSpec, "build", with_notes)


def play(script=lambda request: "WAIT()", steps: int = 3, seeds: int = 1, env: str = TOY, **more) -> list[Trajectory]:
    spec = AgentSpec.from_data({"reasoning": "direct", **more})
    options = {"steps": steps} if env == TOY else {}
    return Runner(spec, ScriptedLLM(script), max_steps=steps).run([Job(Task(env, s, options)) for s in range(seeds)])


def test_what_is_asked_after_a_step_belongs_to_the_step_that_follows(build) -> None:
    (trajectory,) = play()
    tagged = [(c.tag.purpose, c.tag.step) for c in trajectory.calls]
    # Three steps: what store() asks after step t can earn only from t + 1 on; after the last step, nothing any more.
    assert tagged == [
        ("retrieve", 0),
        ("act", 0),
        ("store", 1),
        ("retrieve", 1),
        ("act", 1),
        ("store", 2),
        ("retrieve", 2),
        ("act", 2),
        ("store", 3),
        ("end", 3),
    ]
    assert len(trajectory.transitions) == 3


@pytest.mark.parametrize("occasion", ["retrieve", "store", "end"])
def test_a_module_that_raises_fails_its_own_rollout(build, monkeypatch, occasion: str) -> None:
    def script(request: Request) -> str:
        return "WAIT()"

    sound = play(script, seeds=2)
    monkeypatch.setattr(NoteTaker, "fail_at", occasion)
    broken = play(script)[0]
    assert [t.status for t in sound] == ["completed", "completed"]
    assert broken.status == "failed" and not broken.scorable
    # What was raised, and the line of the module it was raised in.
    assert "TypeError" in broken.error and "test_seams.py" in broken.error and "len(3)" in broken.error


def test_a_defect_of_the_backend_is_not_blamed_on_a_module() -> None:
    def script(request: Request) -> str:
        raise ZeroDivisionError("the backend is broken")

    with pytest.raises(ZeroDivisionError, match="the backend is broken"):
        play(script)


@pytest.mark.parametrize("occasion", ["retrieve", "store", "end"])
def test_a_memory_whose_prompt_is_too_long_does_nothing_and_is_counted(build, monkeypatch, occasion: str) -> None:
    async def too_long(self: NoteTaker, which: str) -> None:
        if which == occasion:
            prompt = [*self.services.context.messages, *self.services.context.messages[:1] * 2000]
            await self.services.llm.generate(which, prompt, max_tokens=20)

    monkeypatch.setattr(NoteTaker, "_ask", too_long)
    spec = AgentSpec.from_data({"reasoning": "direct", "layout": "snapshot"})
    llm = ScriptedLLM(lambda request: "WAIT()", max_context=2000)
    (trajectory,) = Runner(spec, llm).run([Job(Task(TOY, 0, {"steps": 3}))])
    assert trajectory.status == "completed" and trajectory.error == "" and len(trajectory.transitions) == 3
    assert trajectory.metrics["memory/problems/overflow"] == {"retrieve": 3, "store": 3, "end": 1}[occasion]
    assert trajectory.metrics["problems"] == trajectory.metrics["memory/problems/overflow"]


def test_all_calls_of_a_step_are_charged_as_thinking(build) -> None:
    charged: list[int] = []

    def spying(task: Task):
        env = make_env(task)
        env.unwrapped.deliberate = lambda calls, tokens: charged.append(calls)
        return env

    spec = AgentSpec.from_data({"reasoning": "direct"})
    Runner(spec, ScriptedLLM(lambda r: "WAIT()"), make_env=spying).run([Job(Task(TOY, 0, {"steps": 3}))])
    # Step 0: retrieve and act. Then also what store() asked after the step before.
    assert charged == [2, 3, 3]


def test_state_restores_equal_in_order_too() -> None:
    blocks = {"persona": "courier", "human": "", "archive": {"b": 1, "a": 2}}
    restored = load_state(dump_state(blocks))
    assert restored == blocks and list(restored) == list(blocks) and list(restored["archive"]) == ["b", "a"]
    with pytest.raises(TypeError, match=r"key 1 \(int\)"):
        dump_state([{1: "would come back as '1'"}])


def test_a_long_sheet_and_the_newest_steps_reach_the_prompt() -> None:
    memory = {"name": "base", "window": 20, "observation_tokens": 0}
    spec = AgentSpec.from_data({"reasoning": "direct", "memory": memory, "recall_tokens": 64, "layout": "snapshot"})
    prompts: list[str] = []

    def script(request: Request) -> str:
        prompts.append(request.messages[-1].text)
        return "WAIT()"

    Runner(spec, ScriptedLLM(script)).run([Job(Task(TOY, 0, {"steps": 12}))])
    assert "11. WAIT() -> " in prompts[-1] and "\n1. WAIT()" not in prompts[-1]


def transition(**info: object) -> Transition:
    seen = AgentInput("", "The price is 3.\nYou may sell.", ActionSchema({}))
    action = Action("SELL", text="SELL()")
    return Transition(4, seen, Decision(action), "SELL()", 3.0, "next", info=info)


def test_an_experience_is_what_a_memory_keeps_of_a_step() -> None:
    sold = Experience.of(transition(message="sold for 3"))
    assert sold == Experience(4, "The price is 3.\nYou may sell.", "SELL()", True, "sold for 3", 3.0)
    assert sold.line() == "5. SELL() -> sold for 3 (+3.00)"
    block = "State: The price is 3. You may sell.\nAction: SELL()\nResult: sold for 3\nReward: +3.00"
    assert sold.block(100) == block
    # Too long: the state is clipped, action and result stay. 46 characters of the rest, 8 of the label, 20 left.
    rest = "Action: SELL()\nResult: sold for 3\nReward: +3.00"
    assert sold.block(len(rest) + 8 + 20, len) == f"State: The price is 3. ...\n{rest}"
    assert len(sold.block(30, len)) <= 30 and sold.block(30, len).startswith("Action: SELL()")


def test_an_experience_that_was_not_possible_says_so() -> None:
    assert not Experience.of(transition(error="nothing to sell")).ok
    assert Experience.of(transition(error="nothing to sell", message="m")).feedback == "nothing to sell"
    assert not Experience.of(transition(invalid=True)).ok and Experience.of(transition()).feedback == "done"
    broken = Decision(ActionError("SYNTAX", "no call", "hm"))
    seen = AgentInput("", "", ActionSchema({}))
    assert not Experience.of(Transition(0, seen, broken, "hm", 0.0, "")).ok


HELPED = {
    "reasoning": "direct",
    "memory": "summary",
    "roles": {"memory.*": {"backend": "scripted", "script": ["What the helper wrote."]}},
}


def test_a_helper_answers_its_modules_is_metered_and_never_trained() -> None:
    from trainers.sequences import TrainFilter, build_sequences

    asked: list[str] = []

    def policy(request: Request) -> str:
        asked.append(request.tag.module)
        return "WAIT()"

    spec = AgentSpec.from_data(HELPED)
    assert AgentSpec.from_data(spec.to_data()) == spec
    (trajectory,) = Runner(spec, ScriptedLLM(policy)).run([Job(Task(TOY, 0, {"steps": 10}))])
    (summary,) = [c for c in trajectory.calls if c.tag.purpose == "summary"]
    assert set(asked) == {"reasoning.direct"} and summary.text == "What the helper wrote."
    assert b"What the helper wrote." in bytes(i for i in trajectory.calls[-1].prompt_ids if i < 256)
    assert trajectory.metrics["llm_calls"] == 11
    rows = build_sequences(trajectory, TrainFilter(("*",), ("executed", "aux")))
    assert rows and all(summary.id not in row.calls for row in rows)
    # The policy's own summary is trained.
    own = AgentSpec.from_data({k: v for k, v in HELPED.items() if k != "roles"})
    (trajectory,) = Runner(own, ScriptedLLM(policy)).run([Job(Task(TOY, 0, {"steps": 10}))])
    (summary,) = [c for c in trajectory.calls if c.tag.purpose == "summary"]
    rows = build_sequences(trajectory, TrainFilter(("*",), ("executed", "aux")))
    assert any(summary.id in row.calls for row in rows)


def test_recall_in_the_newest_turn_makes_a_row_per_step_and_every_action_is_trained_once() -> None:
    from trainers.sequences import build_sequences

    rows = {}
    for placement in ("newest", "kept"):
        (played,) = play(steps=6, memory={"name": "tests.test_seams:Diary", "window": 3}, recall=placement)
        rows[placement] = build_sequences(played)
        trained = sorted(c for row in rows[placement] for c, m in zip(row.calls, row.mask, strict=True) if m)
        # Six actions of "WAIT()" and the end of the turn: 7 tokens each, none twice, none lost.
        assert len(trained) == 6 * 7 and sorted(set(trained)) == [c.id for c in played.calls]
        longest = max(len(c.prompt_ids) for c in played.calls)
        rows[placement, "longest"] = longest
    # Nothing is recalled in the first step, so the second prompt extends the first: one row of two actions, and one of
    # one action for each of the four prompts after it.
    assert len(rows["kept"]) == 1 and len(rows["newest"]) == 5
    assert rows["newest", "longest"] < rows["kept", "longest"]


def test_an_embedder_that_is_needed_must_be_named() -> None:
    from agentspec.declaration import Declaration
    from agentspec.registry import REGISTRY, Entry, SpecError

    REGISTRY.register("memory", "near", Entry("agentspec.memory.base:BaseMemory", Declaration(needs=("embedder",))))
    try:
        spec = AgentSpec.from_data({"memory": "near"})
        with pytest.raises(SpecError, match="needs an embedder; set `embedder: minilm`"):
            Runner(spec, ScriptedLLM(["WAIT()"])).run([Job(Task(TOY, 0))])
        REGISTRY.unregister("memory", "near")
        spec = AgentSpec.from_data({"memory": "base", "embedder": {"name": "hash", "dim": 16}})
        from agentspec.llm.recorder import Recorder

        agent = spec.build(Recorder(ScriptedLLM(["x"]), episode="e", seed=0))
        assert agent.services[0].embedder is not None and agent.services[0].embedder.dim == 16
    finally:
        REGISTRY.unregister("memory", "near")
