"""Buffer of Thoughts: what counts as new on either side of the threshold, what stands in for it, and who goes first."""

from __future__ import annotations

import asyncio
import json

import pytest

from agentspec.memory.buffer_of_thought import BufferOfThought
from agentspec.memory.buffer_of_thought.templates import COARSE, Template
from agentspec.registry import REGISTRY, SpecError
from agentspec.spec import AgentSpec
from tests.memory.one_step import TASK, Asked, episode, seen, services, step
from tests.memory.recall_world import succeeds


def template(description: str, steps: str = "Do it.", category: str = "c") -> str:
    return json.dumps({"category": category, "description": description, "template": steps})


def shown(memory: BufferOfThought, text: str = "now") -> list[str]:
    return [i.text for i in asyncio.run(memory.retrieve(seen(text))).items]


def play(memory: BufferOfThought, state: str, *actions: str, success: object = None) -> list[str]:
    """An episode; what stood in its prompts."""
    memory.begin_episode(TASK)
    said = shown(memory, state)
    steps = [step(i, state, action, reward=1.0) for i, action in enumerate(actions or ("GO(1)",))]
    for s in steps:
        asyncio.run(memory.store(s))
    metrics = {} if success is None else {"success": success}
    asyncio.run(memory.end_episode(episode(*steps, **metrics)))
    memory.services.clock.episode += 1
    return said


def test_a_task_is_distilled_once_and_worked_on_by_a_coarse_template() -> None:
    script = Asked(distil="Goal: find the key in a room or behind a door.")
    memory = BufferOfThought(services(script))
    memory.begin_episode(TASK)
    said = shown(memory, "A dark hall.")
    assert said[0] == "The task, distilled:\nGoal: find the key in a room or behind a door."
    assert said[1] == f"A way of working, search. For: {COARSE[1].description}\n{COARSE[1].template}"
    assert shown(memory, "Another state.") == said and script.purposes == ["distil"]
    assert "The task:\nDeliver the parcels." in script.prompt() and "A dark hall." in script.prompt()


def test_what_an_episode_taught_is_distilled_when_the_next_begins() -> None:
    script = Asked(distil=["red key", "red key"], template=template("red key", "1. Fetch it.", "keys"))
    memory = BufferOfThought(services(script), preset="rl")
    play(memory, "s0", "GO(1)", "TAKE(2)", success=True)
    assert script.purposes == ["distil"] and not memory.templates
    other = BufferOfThought(services(script), preset="rl")
    other.restore(memory.snapshot())
    said = play(other, "s0")
    assert script.purposes == ["distil", "template", "distil"]
    asked = script.prompt(1)
    for part in ("The task in short:\nred key", "1. GO(1) -> done (+1.00)", "2. TAKE(2) -> done (+1.00)"):
        assert asked.count(part) == 1
    assert "The episode ended after 2 steps. Return: +2.00, a success." in asked
    assert said[1] == "A way of working, keys. For: red key\n1. Fetch it." and other.templates[0].uses == 1
    assert not memory.templates  # the copy shares nothing


# Words a, b, c, d with pairs "a b", "b c", "c d" are 7 features; "a b c e" shares a, b, c and two pairs: 5 / 7 = 0.714.
FIRST, NEAR = "a b c d", "a b c e"


@pytest.mark.parametrize(("threshold", "found"), [(0.71, True), (0.72, False)])
def test_the_threshold_of_looking_up(threshold: float, found: bool) -> None:
    script = Asked(distil=["x", NEAR], template=template(FIRST, "1. Known."))
    memory = BufferOfThought(services(script), threshold=threshold)
    play(memory, "s")
    said = play(memory, "s")
    assert ("1. Known." in said[1]) == found
    assert memory.metrics()["coarse"] == 2 - found


@pytest.mark.parametrize(("threshold", "kept"), [(0.71, 1), (0.72, 2)])
def test_the_threshold_of_keeping(threshold: float, kept: int) -> None:
    script = Asked(distil="x", template=[template(FIRST), template(NEAR)])
    memory = BufferOfThought(services(script), keep_threshold=threshold)
    for _ in range(3):
        play(memory, "s")
    assert [t.description for t in memory.templates] == [FIRST, NEAR][:kept]
    assert memory.metrics()["kept"] == kept and memory.metrics()["known"] == 2 - kept


@pytest.mark.parametrize(("verdict", "kept"), [('{"new": true}', 2), ('{"new": false}', 1), ("perhaps", 1)])
def test_the_model_may_say_what_is_new(verdict: str, kept: int) -> None:
    script = Asked(distil="x", template=[template(FIRST), template(FIRST, "2.")], novel=['{"new": true}', verdict])
    memory = BufferOfThought(services(script), novelty="llm", repairs=0)
    for _ in range(3):
        play(memory, "s")
    assert len(memory.templates) == kept and script.purposes.count("novel") == 2
    novel = [i for i, purpose in enumerate(script.purposes) if purpose == "novel"]
    assert COARSE[0].text() in script.prompt(novel[0])  # before there are any, the coarse ones
    assert f"c: {FIRST}\nDo it." in script.prompt(novel[1]) and COARSE[0].text() not in script.prompt(novel[1])


def test_the_template_used_least_goes_first() -> None:
    memory = BufferOfThought(services(Asked()), max_size=2)
    for text, uses in (("old", 1), ("older", 0), ("newer", 0)):
        memory._keep(Template("c", text, "t", uses))
    assert [t.description for t in memory.templates] == ["old", "newer"] and len(memory._index) == 2  # type: ignore[arg-type]


def test_answers_that_cannot_be_used_are_passed_over() -> None:
    script = Asked(distil=["", "x" * 4000, "y"], template=["prose", template(" ", "1."), template("d", "")])
    memory = BufferOfThought(services(script), repairs=0)
    said = [play(memory, "a door in a room") for _ in range(4)]
    # No distilled task: nothing is said of it, and the first state is looked up. The second answer was cut off.
    assert [len(s) for s in said] == [1, 1, 2, 2]
    assert not memory.templates
    problems = memory.services.llm.recorder.problems
    assert problems["memory.m", "truncated"] == 1 and problems["memory.m", "malformed"] == 1 + 3


def test_without_a_model_the_course_of_names_is_the_template() -> None:
    memory = BufferOfThought(services(Asked(), name="bot"), distiller="none", threshold=0.9)
    play(memory, "red key", "GO(1)", "GO(2)", "TAKE(3)", success=False)
    said = play(memory, "red key")
    assert said == [
        "A way of working, as it was done before. For: red key\n"
        "The episode ended after 3 steps. Return: +3.00, a failure. GO x2, TAKE"
    ]
    assert not memory.services.llm.recorder.calls


def test_long_templates_are_cut_and_parameters_checked() -> None:
    script = Asked(distil="x", template=template("d " * 300, "s" * 900))
    memory = BufferOfThought(services(script), template_tokens=40)
    play(memory, "s")
    play(memory, "s")
    (kept,) = memory.templates
    assert len(kept.template) <= 160 and len(kept.description) <= 40
    for params, message in (
        ({"threshold": 1.5}, "threshold"),
        ({"novelty": "vote"}, "novelty"),
        ({"max_size": 0}, "max"),
    ):
        with pytest.raises(SpecError, match=message):
            AgentSpec.from_data({"memory": {"name": "bot", **params}})
    assert REGISTRY.get("memory", "bot").name == "buffer_of_thought"


@pytest.mark.parametrize("scope", ["episode", "run"])
@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("preset", ["paper", "rl"])
def test_a_fact_seen_long_ago_is_in_the_task_or_the_template(preset: str, layout: str, scope: str) -> None:
    # Under `scope: run` the question's own first state holds no fact: it comes from the template of the episode before.
    memory = {"name": "bot", "preset": preset, "threshold": 0.0}
    assert succeeds(memory, scope=scope, layout=layout)


def test_a_long_distilled_task_keeps_its_whole_sentences_and_a_long_episode_its_end() -> None:
    long = "Key facts: two mills. Constraints: one hour. " + "Goal: earn " + "very " * 400 + "much."
    script = Asked(distil=long, template=template("Deliveries."))
    memory = BufferOfThought(services(script), preset="rl", answer_tokens=64)
    asyncio.run(memory.retrieve(seen("a town")))
    assert memory._problem == "Key facts: two mills. Constraints: one hour."
    assert "in at most 32 words" in script.prompt()
    for i in range(70):
        asyncio.run(memory.store(step(i, f"house {i}", f"GO({i})", message="went past a house, and on")))
    asyncio.run(memory.end_episode(episode(step(0, "x"), step(1, "y"))))
    memory.begin_episode(TASK)
    asyncio.run(memory.retrieve(seen("a town")))
    asked = next(script.prompt(i) for i, name in enumerate(script.purposes) if name == "template")
    assert "70. GO(69)" in asked and "The episode ended after 2 steps." in asked and "are left out" in asked
