"""G-Memory: scores of rules, clusters, the graph of tasks, cadences, what is kept of an episode, what is shown."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.memory.gmemory.insights import Change, Insight, Insights, first_neighbours
from agentspec.registry import SpecError
from tests.memory.bench import Bench, Rows
from tests.memory.recall_world import succeeds

RULES = {"operations": [{"op": "ADD", "rule": None, "text": "Charge first."}]}
NAME = {"name": "gmemory", "repairs": 0, "rank": False, "recent": 0, "every": 99, "merge_every": 99, "threshold": 1.0}
ANSWERS = {"steps": "1. GO()", "mistake": "WAIT() was too long.", "compare": RULES, "merge": {"rules": ["One rule."]}}


def episode(bench: Bench, *rewards: float, state: str = "a town") -> None:
    """An episode with these rewards (it succeeds if they sum up to 1), and the first retrieval of the next one."""
    bench.recall(state)
    for i, reward in enumerate(rewards):
        bench.step(state, f"GO({i})", f"went {i}", reward=reward)
    bench.end()
    bench.recall(state)


def test_operations_change_scores_exactly() -> None:
    rules = Insights(50)
    assert rules.change(Change("ADD", None, "A rule."), [], [7], 0) and rules[0].score == 2
    assert rules.change(Change("agree", 1), [0], [8], 1) and rules[0].score == 3
    assert rules.change(Change("EDIT", 1, "A better rule."), [0], [7], 2)
    assert rules[0] == Insight(0, "A better rule.", 4, (7, 8))
    assert rules.change(Change("REMOVE", 1), [0], [], 3) and rules[0].score == 3
    # No number, an unknown one, nothing to say, a rule that is there: nothing changes.
    for bad in (Change("EDIT", None, "x"), Change("AGREE", 2), Change("AGREE", 0), Change("EDIT", 1, " ")):
        assert not rules.change(bad, [0], [], 4)
    assert not rules.change(Change("ADD", None, ""), [0], [], 4)
    rules.change(Change("ADD", None, "A better rule."), [0], [], 4)
    assert rules.state() == [[0, "A better rule.", 3, [7, 8]]]
    with pytest.raises(ValueError, match="must be one of ADD"):
        Change("BURN")


def test_removing_weighs_three_times_once_there_are_ten_rules() -> None:
    rules = Insights(50)
    for i in range(10):
        rules.put(Insight(i, f"rule {i}", 4))
    rules.change(Change("REMOVE", 1), list(range(10)), [], 99)
    assert rules[0].score == 1
    rules.change(Change("REMOVE", 1), list(range(10)), [], 99)
    assert 0 not in rules and len(rules) == 9  # 1 - 3 <= 0
    rules.change(Change("REMOVE", 2), list(range(10)), [], 99)
    assert rules[1].score == 3  # nine are left


def test_a_task_confirms_or_refutes_the_rules_it_was_shown() -> None:
    rules = Insights(50)
    rules.put(Insight(0, "a"))
    rules.put(Insight(1, "b"))
    rules.judge([0], True)
    assert (rules[0].score, rules[1].score) == (3, 2)
    rules.judge([0, 1], False)
    assert rules[0].score == 1 and 1 not in rules  # 2 - 2 = 0 goes


def test_the_lowest_score_makes_room_and_rules_of_more_tasks_come_first() -> None:
    rules = Insights(2)
    for i, (score, tasks) in enumerate([(2, (1,)), (5, (1,)), (3, (1, 2))]):
        rules.put(Insight(i, f"rule {i}", score, tasks))
    assert [r.id for r in rules] == [1, 2]
    assert [r.id for r in rules.for_tasks([1, 2], 9)] == [2, 1] and [r.id for r in rules.for_tasks([1], 9)] == [1, 2]
    assert rules.for_tasks([3], 9) == []


@given(st.lists(st.sampled_from(["ADD", "EDIT", "AGREE", "REMOVE"]), max_size=40), st.data())
def test_scores_stay_above_nought_and_rules_within_bounds(ops: list[str], data: st.DataObject) -> None:
    rules = Insights(5)
    for i, op in enumerate(ops):
        shown = [rule.id for rule in rules]
        rules.change(Change(op, data.draw(st.integers(-1, 7)), f"rule {i}"), shown, [i], i)
    assert len(rules) <= 5 and all(rule.score > 0 for rule in rules)


def test_blobs_are_clusters_by_first_neighbours() -> None:
    angles = np.array([0.0, 1.5, 0.05, 1.55, 0.1])  # two blobs: 0, 2, 4 and 1, 3
    vectors = np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)
    assert [sorted(c) for c in first_neighbours(vectors)] == [[0, 2, 4], [1, 3]]
    assert first_neighbours(vectors[:1]) == [[0]] and first_neighbours(vectors[:0]) == []


def test_only_steps_that_cost_something_are_left_out_of_the_chain() -> None:
    bench = Bench(NAME, ANSWERS, scope="run")
    episode(bench, 0.0, -0.5, 2.0)
    prompt = bench.prompt("steps")
    assert "succeeded (return +1.50)" in prompt and "Deliver food." in prompt
    assert "1. GO(0)" in prompt and "3. GO(2)" in prompt and "2. GO(1)" not in prompt
    assert bench.purposes() == ["steps"]
    assert bench.shown() == "An earlier episode succeeded (return +1.50, 3 steps): 1. GO()"


def test_a_failure_is_asked_for_its_mistake_and_nothing_at_the_episodes_end() -> None:
    bench = Bench(NAME, ANSWERS, scope="run")
    bench.step("a town")
    bench.end()
    assert bench.asked == []
    bench.recall("a town")
    bench.recall("elsewhere")  # once per episode
    assert bench.purposes() == ["mistake"] and "WAIT() was too long." in bench.shown()


def test_the_environments_word_counts_before_the_return() -> None:
    bench = Bench({**NAME, "threshold": None}, ANSWERS, scope="run")
    for ending in ({"success": True}, {"success": False}):
        bench.step("a town")
        bench.end(**ending)
        bench.recall("a town")
    assert bench.purposes() == ["steps", "mistake"] and "failed (return +0.00)" in bench.prompt("mistake")


def test_graded_episodes_went_well_if_they_are_above_the_mean_so_far() -> None:
    bench = Bench({**NAME, "threshold": None}, ANSWERS, scope="run")
    for reward in (4.0, 3.0, 3.0, 5.0):  # against 0, 4, 3.5, 10/3
        episode(bench, reward)
    assert bench.purposes() == ["steps", "mistake", "mistake", "steps"]
    assert "went well (return +5.00)" in bench.prompt("steps") and "went badly (return +3.00" in bench.shown()


def test_without_a_reading_the_actions_stand_for_the_key_steps() -> None:
    bench = Bench(NAME, {**ANSWERS, "steps": ""}, scope="run")
    episode(bench, 1.0)
    assert bench.shown().endswith(": 1. GO(0) -> went 0 (+1.00)") and bench.problems() == {"malformed": 1}


def towns(*names: str, **more: object) -> Bench:
    """Episodes in these towns; A and B are alike (0.8), C is like B (0.8) and not like A (0.28)."""
    world = Rows({"town A": [1.0, 0.0], "town B": [0.8, 0.6], "town C": [0.28, 0.96], "town Z": [-1.0, 0.0]})
    answers = {**ANSWERS, "steps": [f"visited {name}" for name in names]}
    bench = Bench({**NAME, **more}, answers, embedder=world, scope="run")
    for name in names:
        bench.recall(name)
        bench.step(name, "GO()", reward=1.0)
        bench.end()
    return bench


def test_tasks_are_joined_from_the_threshold_on() -> None:
    graph = towns("town A", "town B", "town C").memory.graph
    assert [(a, b) for a, b, _ in graph.edges()] == [(0, 1), (1, 2)]
    assert len(list(towns("town A", "town B", "town C", edge=0.81).memory.graph.edges())) == 0


def test_rules_of_neighbours_are_found_over_one_hop() -> None:
    for hops, found in ((0, False), (1, True), (2, True)):
        bench = towns("town A", "town B", hops=hops)
        first = next(iter(bench.memory.episodes)).id
        bench.memory.insights.put(Insight(99, "A rule of town A.", 2, (first,)))
        # C is like B alone; A is one hop further.
        assert ("A rule of town A." in bench.shown("town C")) is found


def test_relevance_orders_the_successes_and_unlike_ones_are_not_candidates() -> None:
    bench = towns("town A", "town B", "town Z", successes=1)
    bench.memory.rank = True
    for better in ("town A", "town B"):
        bench.answers["relevance"] = lambda r, said=f": visited {better}": {"score": 9 if said in text_of(r) else 2}
        bench.end()
        [item] = bench.recall("town A").items
        assert item.text.endswith(f": visited {better}")
    asked = [r.messages[-1].text for r in bench.asked if r.tag.purpose == "relevance"]
    assert len(asked) == 4 and not any("visited town Z" in text for text in asked)


def test_rounds_of_comparison_and_mergers_come_at_their_cadence() -> None:
    bench = Bench({**NAME, "every": 2, "comparisons": 3, "merge_every": 4}, ANSWERS, scope="run")
    two = {"operations": [{"op": "ADD", "rule": None, "text": t} for t in ("Charge first.", "Then go.")]}
    bench.answers["compare"] = two
    for number in range(1, 5):
        episode(bench, 1.0)
        assert bench.purposes().count("compare") == 3 * (number // 2)
        assert bench.purposes().count("merge") == number // 4
    assert [rule.text for rule in bench.memory.insights] == ["One rule."]
    assert "1. Charge first.\n2. Then go." in bench.prompt("merge") and "at most 1" in bench.prompt("merge")


def test_shown_rules_are_confirmed_by_success_and_refuted_by_failure() -> None:
    bench = Bench(
        {**NAME, "every": 1, "comparisons": 1}, {**ANSWERS, "compare": [RULES, {"operations": []}]}, scope="run"
    )
    episode(bench, 1.0)
    assert "- Charge first." in bench.shown() and [r.score for r in bench.memory.insights] == [2]
    episode(bench, 1.0)
    assert [r.score for r in bench.memory.insights] == [3]
    episode(bench, 0.0)
    assert [r.score for r in bench.memory.insights] == [1]


def test_the_oldest_episode_goes_with_its_edges() -> None:
    bench = towns("town A", "town B", "town C", capacity=2)
    assert len(bench.memory.episodes) == 2 and len(bench.memory.graph) == 2 and bench.memory.metrics()["evicted"] == 1


def test_parameters_out_of_range_are_refused() -> None:
    for params in ({"successes": 0}, {"hops": -1}, {"capacity": 0}):
        with pytest.raises(SpecError):
            Bench({"name": "gmemory", **params})


def test_gmemory_recalls_the_episode_before() -> None:
    assert not succeeds({"name": "base", "window": 5}, scope="run")
    assert succeeds({"name": "gmemory", "preset": "rl"}, scope="run", delay=10)


def text_of(request) -> str:
    return request.messages[-1].text


def test_the_step_that_made_an_episode_fail_is_in_the_question_for_its_mistake() -> None:
    bench = Bench(NAME, ANSWERS, scope="run")
    bench.step("a store", "BUY(5)", "bought 5 drinks", reward=-30.0)
    bench.step("a town", "DROP_OFF(1)", "delivered", reward=8.0)
    bench.end(success=False)
    bench.recall("a town")
    assert "1. BUY(5) -> bought 5 drinks (-30.00)" in bench.prompt("mistake")


def test_the_end_of_a_long_episode_is_in_its_question() -> None:
    bench = Bench({**NAME, "preset": "rl", "trial_tokens": 400}, ANSWERS, scope="run")
    for i in range(60):
        bench.step(f"a long way past house {i}, with nothing to be seen", f"GO({i})", f"went past house {i}")
    bench.step("a ditch", "JUMP()", "fell into the ditch", reward=-1.0)
    bench.end(success=False)
    bench.recall("a town")
    prompt = bench.prompt("mistake")
    assert "1. GO(0)" in prompt and "61. JUMP() -> fell into the ditch (-1.00)" in prompt
