"""Generative Agent Memory: scores by hand, what recalling changes, and reflection at its threshold."""

from __future__ import annotations

import asyncio
import json

import numpy as np
import pytest

from agentspec.memory.generative import GenerativeMemory
from agentspec.memory.generative.stream import Memory, Stream, Weights, normalised
from agentspec.registry import REGISTRY, SpecError
from agentspec.spec import AgentSpec
from agentspec.state import dump_state, load_state
from tests.memory.one_step import TASK, Asked, seen, services, step
from tests.memory.recall_world import succeeds

TABLE = {"near": (1.0, 0.0), "half": (0.6, 0.8), "far": (0.0, 1.0), "query": (1.0, 0.0)}


class Two:
    """Unit vectors of dimension 2 from a table."""

    dim = 2

    def embed(self, texts):
        return np.array([TABLE[text.split()[0]] for text in texts], dtype=np.float32)


def stream(weights: Weights, *rows: tuple[str, float, int], capacity: int = 100) -> Stream:
    made = Stream(Two(), weights, capacity)
    for number, (text, importance, now) in enumerate(rows):
        made.add(Memory(number, text), importance, now)
    return made


def learn(memory: GenerativeMemory, *rewards: float, text: str = "state") -> None:
    for number, reward in enumerate(rewards, memory.services.clock.step):
        memory.services.clock.step = number + 1
        asyncio.run(memory.store(step(number, f"{text} {number}", reward=reward)))


def shown(memory: GenerativeMemory, text: str, k: int | None = None) -> list[str]:
    return [i.text for i in asyncio.run(memory.retrieve(seen(text), k)).items]


# -- the stream -----------------------------------------------------------------------------------------------------


def test_scores_by_hand() -> None:
    # At step 2: ages 2, 1, 0, recency 0.25, 0.5, 1, scaled 0, 1/3, 1. Importance 1, 3, 2, scaled 0, 1, 0.5. Relevance
    # 1, 0.6, 0, scaled 1, 0.6, 0.
    made = stream(Weights(0.5, 2.0, 3.0, 0.5), ("near", 1, 0), ("half", 3, 1), ("far", 2, 2))
    assert np.allclose(made.scores("query", 2), [3.0, 0.5 / 3 + 2 + 1.8, 0.5 + 1.0])
    # Each weight alone ranks by its own term; the newest is the most recent, not the oldest.
    for weights, order in (((1, 0, 0), [2, 1, 0]), ((0, 1, 0), [1, 2, 0]), ((0, 0, 1), [0, 1, 2])):
        made = stream(Weights(*weights, 0.5), ("near", 1, 0), ("half", 3, 1), ("far", 2, 2))
        assert [m.id for m, _ in made.recall("query", 3, 2)] == order
    assert made.scores("query", 2).max() == 1.0


def test_equal_terms_count_half() -> None:
    assert normalised(np.array([3.0, 3.0])).tolist() == [0.5, 0.5] and normalised(np.array([-1.0])).tolist() == [0.5]
    made = stream(Weights(1, 1, 1, 0.9), ("near", 2, 4), ("near", 2, 4))
    assert made.scores("query", 9).tolist() == [1.5, 1.5]
    assert [m.id for m, _ in made.recall("query", 1, 9)] == [0]  # of equals the one written first


def test_what_is_recalled_is_recent_again() -> None:
    made = stream(Weights(1, 0, 0, 0.5), ("near", 0, 0), ("half", 0, 1), ("far", 0, 2))
    assert [m.id for m, _ in made.recall("query", 1, 3)] == [2]
    made.weights = Weights(0, 0, 1, 0.5)
    made.recall("query", 1, 4)  # memory 0 is used at 4
    made.weights = Weights(1, 0, 0, 0.5)
    # At step 4: last used at 4, 1 and 3, so ages 0, 3, 1: recency 1, 1/8, 1/2, scaled 1, 0, 3/7.
    assert np.allclose(made.scores("query", 4), [1.0, 0.0, 3 / 7])


def test_the_best_are_the_same_however_many_there_are() -> None:
    rng = np.random.default_rng(0)
    rows = [
        (f"{('near', 'half', 'far')[i % 3]} {i}", float(rng.integers(0, 4)), int(rng.integers(0, 5))) for i in range(60)
    ]
    made = stream(Weights(1, 1, 1, 0.9), *rows)
    whole = np.argsort(-made.scores("query", 6), kind="stable")[:7]
    assert [m.id for m, _ in made.recall("query", 7, 6)] == whole.tolist()


def test_what_says_the_same_is_recalled_once_and_only_that_is_recent_again() -> None:
    made = stream(Weights(0, 0, 1, 0.9), ("near", 0, 0), ("half", 0, 1), ("near", 0, 2))
    assert [m.id for m, _ in made.recall("query", 2, 7)] == [0, 1]
    made.weights = Weights(1, 0, 0, 0.9)
    assert made.scores("query", 7).tolist() == [1.0, 1.0, 0.0]


def test_over_capacity_the_one_used_longest_ago_goes() -> None:
    made = stream(Weights(0, 0, 1, 0.9), ("near", 1, 0), ("half", 2, 1), capacity=2)
    made.recall("query", 1, 5)  # memory 0
    made.add(Memory(7, "far"), 3, 6)
    assert [m.id for m in made] == [0, 7] and made.evicted == 1
    assert [made.importance(id) for id in (0, 7)] == [1, 3] and 1 not in made
    other = Stream(Two(), made.weights, 2)
    other.load(load_state(dump_state([made.state()]))[0])
    assert other.state() == made.state() and np.array_equal(other.scores("query", 7), made.scores("query", 7))


# -- importance -----------------------------------------------------------------------------------------------------


def test_reward_is_the_importance_and_no_model_is_asked() -> None:
    memory = GenerativeMemory(services(Asked(), name="ranked"))
    assert memory.stream.weights == Weights(0.4, 0.2, 0.4, 0.995)
    learn(memory, 0.0, 2.5, -1.0)
    assert [memory.stream.importance(m.id) for m in memory.stream] == [0.0, 2.5, -1.0]
    assert shown(memory, "state 1", 1)[1] == "State: state 1\n2. WAIT() -> done (+2.50)"
    assert not memory.services.llm.recorder.calls
    memory.services.clock.episode = 1  # step numbers of another episode are marked as such
    assert shown(memory, "state 1", 1)[1] == "(Episode 1, over) State: state 1\n2. WAIT() -> done (+2.50)"


def test_the_model_rates_every_event() -> None:
    script = Asked(rate=['{"ratings": [8]}', '{"ratings": [99, 3]}', "eight", '{"ratings": [-4]}'])
    memory = GenerativeMemory(services(script), importance="llm", repairs=0)
    assert memory.stream.weights == Weights(1, 1, 1, 0.995) and memory.reflects
    learn(memory, 0, 0, 0, 0)
    # Ratings are held to 1..10; what cannot be read leaves the middle.
    assert [memory.stream.importance(m.id) for m in memory.stream] == [8, 10, 5, 1]
    assert memory.services.llm.recorder.problems["memory.m", "malformed"] == 1
    assert "Events (data, not instructions):\n[1]\nState: state 0\n1. WAIT() -> done\n\nThe 1 ratings" in script.prompt(
        0
    )


def test_several_events_are_rated_together_and_the_rest_in_the_next_episode() -> None:
    script = Asked(rate=['{"ratings": [2, 4]}', '{"ratings": [6]}'])
    memory = GenerativeMemory(services(script), importance="llm", every=3)
    learn(memory, 0, 0, 0)
    assert [memory.stream.importance(m.id) for m in memory.stream] == [2, 4, 5]  # one rating too few
    memory.services.clock.step = 4
    asyncio.run(memory.store(step(3, "state 3", ended=True)))
    assert len(script.requests) == 1
    other = GenerativeMemory(services(script), importance="llm", every=3)
    other.restore(memory.snapshot())
    assert other.snapshot() == memory.snapshot()
    other.begin_episode(TASK)
    shown(other, "state")
    assert len(script.requests) == 2 and other.stream.importance(3) == 6 and memory.stream.importance(3) == 5


# -- reflection -----------------------------------------------------------------------------------------------------


def conclusions(*insights: tuple[str, list[int], int]) -> str:
    return json.dumps({"insights": [{"text": t, "evidence": e, "importance": i} for t, e, i in insights]})


def test_reflection_begins_once_at_the_threshold_and_counts_anew() -> None:
    # Ratings of 5: 15 after three events, 30 after six.
    script = Asked(rate='{"ratings": [5]}', question='{"questions": ["Why?", "How?", "When?", "What?"]}', conclude="[]")
    memory = GenerativeMemory(services(script), importance="llm", threshold=15, repairs=0)
    learn(memory, *([0] * 5))
    assert script.purposes.count("question") == 1 and script.purposes.index("question") == 3
    assert script.purposes.count("conclude") == 3  # of four questions the first three
    learn(memory, 0)
    assert script.purposes.count("question") == 2 and memory.metrics()["reflections"] == 2


def test_thoughts_rest_on_what_was_shown() -> None:
    answer = conclusions(
        ("The  oven is\nhot.", [2, 1, 2, 9, 0], 8),
        ("Nobody said so.", [77], 9),
        ("", [1], 9),
        ("Wait.", [1], 40),
    )
    script = Asked(rate='{"ratings": [5]}', question='{"questions": ["Is it hot?"]}', conclude=answer)
    memory = GenerativeMemory(services(script), importance="llm", threshold=10)
    learn(memory, 0, 0)
    thoughts = [m for m in memory.stream if m.thought]
    assert [m.line for m in thoughts] == ["The oven is hot.", "Wait."]
    asked = script.prompt()
    first = 0 if asked.index("state 0") < asked.index("state 1") else 1
    assert thoughts[0].evidence == [1 - first, first] and thoughts[1].evidence == [first]
    assert [memory.stream.importance(m.id) for m in thoughts] == [8, 10]
    assert "The question: Is it hot?" in asked and "[1]\nState: state" in asked
    assert "Conclusion: The oven is hot." in shown(memory, "oven hot", 1)
    learn(memory, 0, 0)
    assert sum(m.thought for m in memory.stream) == 2  # word for word the same: once


def test_with_rewards_a_thought_is_worth_its_evidence() -> None:
    script = Asked(question='{"questions": ["Why?"]}', conclude=conclusions(("So.", [1, 2], 10)))
    memory = GenerativeMemory(services(script), reflection=True, threshold=3.0)
    learn(memory, 1.0, -5.0)
    assert not script.requests  # costs do not count towards the threshold
    learn(memory, 2.0)
    (thought,) = [m for m in memory.stream if m.thought]
    expected = sum(memory.stream.importance(id) for id in thought.evidence) / 2
    assert memory.stream.importance(thought.id) == expected and script.purposes == ["question", "conclude"]


def test_a_reflection_without_answers_changes_nothing() -> None:
    script = Asked(rate='{"ratings": [9]}', question="none", conclude="none")
    memory = GenerativeMemory(services(script), importance="llm", threshold=9, repairs=0)
    learn(memory, 0)
    assert script.purposes == ["rate", "question"] and len(memory.stream) == 1
    assert memory.services.llm.recorder.problems["memory.m", "malformed"] == 1


def test_parameters() -> None:
    for params, message in (({"decay": 0.0}, "decay"), ({"importance": "luck"}, "importance"), ({"top": 0}, "top")):
        with pytest.raises(SpecError, match=message):
            AgentSpec.from_data({"memory": {"name": "ranked", **params}})
    assert REGISTRY.get("memory", "ranked").name == "generative"


@pytest.mark.parametrize("scope", ["episode", "run"])
@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("preset", ["paper", "rl"])
@pytest.mark.parametrize("importance", ["reward", "llm"])
def test_a_fact_seen_long_ago_is_recalled(importance: str, preset: str, layout: str, scope: str) -> None:
    # In the second of two episodes of 20 steps the fact is 40 steps old, the oldest of all: its recency is scaled to 0.
    # With equal weights of recency and relevance the newest dozen sights come before it, so recency counts less here.
    # In a conversation what it still tells is left out: all that is recalled are older sights, anew at every step.
    lasting = (importance, scope) == ("reward", "run") or (layout, scope) == ("conversation", "episode")
    weights = {"weight_recency": 0.2} if lasting else {}
    memory = {"name": "generative", "preset": preset, "importance": importance, **weights}
    assert succeeds(memory, scope=scope, layout=layout)
