"""The world in which one fact decides: what it asks of a memory, held against memories whose reach is known."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from agentspec.envs.contract import check_environment
from agentspec.registry import REGISTRY
from agentspec.types import Task
from tests.fixtures import trial_memories
from tests.memory.recall_world import FACTS, RECALL, SIGHTS, fact_of, succeeds, walk


@pytest.fixture
def trials() -> Iterator[None]:
    names = REGISTRY.add_module(trial_memories)
    yield
    for name in names:
        REGISTRY.unregister("memory", name)


def test_the_world_keeps_the_contract() -> None:
    for part in ("both", "show", "ask"):
        check_environment(Task(RECALL, options={"delay": 6, "part": part}))


def test_the_fact_stands_nowhere_but_in_the_notice() -> None:
    values = [value.casefold() for _, _, values in FACTS.values() for value in values]
    assert not [v for v in values for s in SIGHTS if v in s.casefold()]
    assert {fact_of(seed)[0] for seed in range(3)} == set(FACTS)
    for seed in range(3):
        [trajectory], _ = walk("none", seed=seed)
        texts = [t.input.text for t in trajectory.transitions]
        assert [i for i, text in enumerate(texts) if fact_of(seed)[1] in text] == [0]
        assert "The guard asks:" in texts[20] and len(texts) == 21


def test_a_window_recalls_what_it_reaches() -> None:
    # The question is asked at step 20: a window of 5 holds steps 15 to 19, one of 30 all of them. What was seen at
    # step 0 is the notice of about 14 tokens.
    assert not succeeds("none")
    assert not succeeds({"name": "base", "window": 5})
    assert succeeds({"name": "base", "window": 30}, recall_tokens=4000)


def test_a_buffer_of_the_episode_knows_nothing_of_the_one_before() -> None:
    assert not succeeds({"name": "base", "window": 30}, scope="run", recall_tokens=4000)


@pytest.mark.parametrize("scope", ["episode", "run"])
@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("name", ["cheat_sheet", "insights"])
def test_the_model_keeps_what_its_prompts_show(trials: None, name: str, scope: str, layout: str) -> None:
    # A sheet that is rewritten keeps the fact; insights, drawn from actions when the episode is over, never saw it.
    assert succeeds(name, scope=scope, layout=layout) == (name == "cheat_sheet")


def test_an_answer_of_ones_own_replaces_the_example(trials: None) -> None:
    assert not succeeds("cheat_sheet", curate={"curate": '{"sheet": "nothing"}'})
    [trajectory], reader = walk("cheat_sheet", curate={"curate": lambda request: '{"sheet": "It is K7Q2."}'})
    assert sum(r.tag.purpose == "curate" for r in reader.asked) == len(trajectory.transitions)
