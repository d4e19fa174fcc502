"""Mixtures of scaffolds, and an expert that is played through them."""

from __future__ import annotations

import json
from typing import Any

import pytest

from agentspec.declaration import Purpose
from agentspec.demonstration import Words, notes_of, play_expert
from agentspec.llm.base import LLMError, Request, user
from agentspec.mixture import mixture
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.tasks import make_tasks
from agentspec.types import ActionSchema, AgentInput, CallTag, Sampling, Task
from tests.toy_env import TOY

SHARED = {"sampling": {"max_tokens": 512}, "embedder": "hash", "layout": "snapshot"}
MEMORY = {"level": "MiniGrid-MemoryS7-v0", "observation": "compact", "action_mode": "menu", "max_steps": 12}


def test_an_entry_is_all_combinations_of_its_alternatives() -> None:
    given = [{"memory": ["none", "base"], "layout": ["conversation", "snapshot"]}, {"reasoning": "react"}]
    specs = mixture({"sampling": {"max_tokens": 7}}, given)
    assert [spec.label for spec in specs] == [
        "direct+none",
        "direct+none (snapshot)",
        "direct+base",
        "direct+base (snapshot)",
        "react+none",
    ]
    assert {spec.sampling.max_tokens for spec in specs} == {7}
    assert mixture({"memory": "base"}, None) == [AgentSpec.from_data({"memory": "base"})]
    assert len(mixture({}, [{"memory": "base"}, {"memory": ["none", "base"]}])) == 2  # each once


@pytest.mark.parametrize(
    ("held_out", "found"),
    [
        ({"reasoning": "mad"}, None),
        ({"reasoning": "react", "memory": "none"}, None),
        ({"memory": "base"}, "react\\+base"),
        ({"reasoning": ["direct", "react"], "layout": "snapshot"}, "direct\\+none"),
        ({"memory": {"name": "base", "window": 9}}, None),  # another memory than the one that is in it
    ],
)
def test_what_is_held_out_must_not_be_in_the_mixture(held_out: dict[str, Any], found: str | None) -> None:
    given = [{"memory": "none"}, {"reasoning": "react", "memory": "base"}]
    if found is None:
        assert len(mixture(SHARED, given, [held_out])) == 2
        return
    with pytest.raises(SpecError, match=f"held_out: .* is in the mixture \\({found}"):
        mixture(SHARED, given, [held_out])


@pytest.mark.parametrize("given", [[], "direct", ["direct"], [{"memory": []}], [{"memory": "bsae"}]])
def test_what_is_no_mixture(given: Any) -> None:
    with pytest.raises(SpecError):
        mixture({}, given)


@pytest.fixture(scope="module")
def tokenizer() -> Any:
    pytest.importorskip("trl")
    from tests.tiny import tiny_tokenizer

    return tiny_tokenizer()


@pytest.mark.parametrize("reasoning", ["direct", "react", {"name": "mad", "preset": "rl"}])
@pytest.mark.parametrize(
    "memory",
    [
        "base",
        {"name": "summary", "every": 2, "summary_tokens": 256},
        {"name": "dynamic_cheatsheet", "every": 2},
        {"name": "dynamic_cheatsheet", "preset": "rl", "every": 2},
        {"name": "memorybank", "every": 2, "overview_every": 1, "answer_tokens": 512},
        {"name": "openclaw", "every": 2, "answer_tokens": 512},
    ],
)
def test_the_expert_acts_and_answers_memories_in_every_scaffold(tokenizer: Any, reasoning: Any, memory: Any) -> None:
    pytest.importorskip("minigrid")
    spec = AgentSpec.from_data({**SHARED, "reasoning": reasoning, "memory": memory})
    (episode,) = play_expert(spec, tokenizer, make_tasks("minigrid", MEMORY, 1))
    # The scaffold changes nothing of what the expert does, and every memory can read what it is answered.
    assert episode.metrics["success"] == 1 and not episode.metrics["problems"]
    written = [c for c in episode.calls if c.tag.module.startswith("memory.")]
    assert bool(written) == (memory != "base")
    assert all(c.completions[0].finish_reason == "stop" for c in episode.calls if c.tag.purpose != "act")
    if written and "overview" not in written[-1].tag.purpose:
        assert any("The object of the start room is a green" in c.text for c in written)
    thoughts = [c.text for c in episode.calls if c.tag.purpose == "think"]
    assert thoughts == [f"Next: {t.action_text}." for t in episode.transitions if reasoning == "react"]


def test_the_object_of_the_start_room_is_noted_once_it_was_seen() -> None:
    pytest.importorskip("minigrid")
    from agentspec.episode import Job, Runner

    spec = AgentSpec.from_data({"reasoning": "rule_based"})
    # Layout 0 begins in the hallway, facing its end: the expert turns round to look before it chooses.
    episodes = Runner(spec).run([Job(task) for task in make_tasks("minigrid", MEMORY, 8)])
    told = [
        [notes_of(e.task, [e.transitions[0].input])[0], notes_of(e.task, [e.transitions[-1].input])[0]]
        for e in episodes
    ]
    assert any(not first.startswith("The object") for first, _ in told)
    assert all(last.startswith("The object of the start room is a green") for _, last in told)


def request(purpose: str, most: int, text: str = "") -> Request:
    return Request((user(text),), Sampling(max_tokens=most), CallTag("memory.m", purpose, "e", 0))


EXAMPLES = {
    "summary": "It is so.",
    "insight": '{"insights": ["It is so."], "next": []}',
    "curate": "<sheet>\n- It is so.\n</sheet>",
}


class Played:
    """Stands for an episode of which nothing was seen."""

    task = Task(TOY, 0)
    transitions = ()


def test_an_answer_has_room_and_what_nobody_can_answer_is_refused() -> None:
    purposes = {name: Purpose("store", example) for name, example in EXAMPLES.items()}
    words = Words({"e": Played()}, len, purposes)  # type: ignore[dict-item]
    assert words(request("summary", 100)) == "Nothing yet."
    assert len(words(request("summary", 8))) <= 7
    assert json.loads(words(request("insight", 100))) == {"insights": [], "next": []}
    assert "<sheet>" in words(request("curate", 100, "between\n<sheet>\nand </sheet>"))
    with pytest.raises(LLMError, match=r"no demonstration for memory.m/judge .* leave this scaffold out"):
        words(request("judge", 100))


def test_a_world_without_notes_tells_what_was_seen_last() -> None:
    seen = [AgentInput("rules", text, ActionSchema({})) for text in ("first", "a price\nof 3")]
    assert notes_of(Task(TOY, 0), seen) == ["Seen last: a price of 3"] and notes_of(Task(TOY, 0), []) == []


def test_the_courier_notes_what_became_of_its_orders() -> None:
    text = "11 min left, scooter, earned $0.0\norder 3: in bag, 1 min left, $7.0\nchoices: go; wait"
    task = Task("deliverybench", 0, {"size": "tiny"})
    assert notes_of(task, [AgentInput("", text, ActionSchema({}))]) == [
        "11 min left, scooter, earned $0.0.",
        "Order 3: in bag, 1 min left, $7.0.",
    ]
