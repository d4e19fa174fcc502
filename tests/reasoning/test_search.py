"""The shared search tools: UCT and the tree, RAP's search against its reference numbers, budgets."""

from __future__ import annotations

import asyncio
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.llm.base import user
from agentspec.llm.recorder import Budget, BudgetExceededError, ModuleLLM, Recorder
from agentspec.llm.scripted import ScriptedLLM
from agentspec.reasoning.search import mcts
from agentspec.reasoning.search.judge import last_number, last_word
from agentspec.reasoning.search.meter import Ask, Meter, OutOfBudgetError
from agentspec.reasoning.search.tree import Node, backpropagate, best_leaf, close, nodes_where, select, uct


def test_uct_value() -> None:
    # 0.5 + 1 * sqrt(ln 10 / 3) = 0.5 + sqrt(2.302585 / 3) = 0.5 + 0.876086
    assert uct(0.5, 10, 3, 1.0) == pytest.approx(1.376086, abs=1e-6)
    assert uct(0.5, 10, 0, 0.0) == 0.5


class Toy:
    """llm-reasoners' toy: numbers from 0, add 1 or 2, over at 3 or more; exactly 3 pays 1, anything else 0.1."""

    def __init__(self) -> None:
        self.visited: list[Node] = []

    async def visit(self, node: Node) -> None:
        assert node.parent is not None
        self.visited.append(node)
        node.state = node.parent.state + int(node.action)
        node.reward = 1.0 if node.state == 3 else 0.1
        node.terminal = node.state >= 3

    async def actions(self, node: Node) -> list[Node]:
        return [Node("1", node, prior=0.5), Node("2", node, prior=0.4)]


def grow(iterations: int, **settings) -> tuple[Node, Toy]:
    root, toy = Node(state=0), Toy()
    asyncio.run(mcts.search(root, toy, **{"iterations": iterations, "depth": 4, "weight": 1.0, **settings}))
    return root, toy


def test_rap_reproduces_the_reference_on_its_toy() -> None:
    # Reference: llm-reasoners 1.0.2, w = 1, depth 4, 8 iterations.
    root, toy = grow(8)
    assert [child.visits for child in root.children or []] == [6, 2]
    found = best_leaf(root, 4)
    assert found is not None
    assert found[0] == pytest.approx(1.2) and found[1].actions == ["1", "1", "1"]  # 0 -> 1 -> 2 -> 3: .1 + .1 + 1
    assert len(toy.visited) == len(set(map(id, toy.visited)))  # the world model once per edge


@given(st.integers(1, 40), st.integers(1, 5), st.floats(0, 3))
def test_visits_are_conserved(iterations: int, depth: int, weight: float) -> None:
    root, _ = grow(iterations, depth=depth, weight=weight)
    assert root.visits == iterations == sum(c.visits for c in root.children or [])
    for node in nodes_where(root, lambda n: bool(n.children)):
        # A path ends at a node at most once before it has children, in the iteration that expands it: RAP's goes on.
        assert sum(c.visits for c in node.children or []) == node.visits


def test_backpropagation_adds_the_rewards_to_the_end() -> None:
    root = Node()
    a = Node("a", root, reward=1.0)
    b = Node("b", a, reward=10.0)
    assert backpropagate([root, a, b], tail=100.0) == 111.0
    assert (root.returns, a.returns, b.returns) == ([111.0], [111.0], [110.0])
    assert b.actions == ["a", "b"] and b.first is a and b.depth == 2


def test_select_takes_the_greatest_bound_and_passes_over_closed_nodes() -> None:
    root = Node(returns=[0.0] * 4)
    root.children = [Node(str(i), root, prior=p) for i, p in enumerate((0.1, 0.9, 0.5))]
    assert select(root, 1.0, 5)[-1].action == "1"
    close(root.children[1])
    assert select(root, 1.0, 5, open_only=True)[-1].action == "2"
    close(root.children[0])
    close(root.children[2])
    assert root.closed


def meter(answers, budget: Budget | None = None, **limits) -> Meter:
    recorder = Recorder(ScriptedLLM(answers), episode="e", seed=0, budget=budget)
    return Meter(ModuleLLM(recorder, "reasoning.test"), **limits)


def ask(text: str) -> Ask:
    return Ask("p", [user(text)])


def test_the_budget_of_a_search_returns_what_was_affordable() -> None:
    m = meter(lambda r: r.messages[-1].text, calls=2)
    calls = asyncio.run(m.ask_all([ask("a"), ask("b"), ask("c")]))
    assert [c.text for c in calls] == ["a", "b"] and m.exhausted == "calls" and m.calls == 2
    with pytest.raises(OutOfBudgetError, match="limit of 2 calls"):
        m.stop()


def test_tokens_are_counted_after_each_request() -> None:
    m = meter(["answer"], tokens=1)
    asyncio.run(m.ask("p", [user("x")]))
    # "x" with its role, end and the assistant's role is 4 tokens, "answer" and its end 7.
    assert m.tokens == 11
    with pytest.raises(OutOfBudgetError, match="limit of 1 tokens"):
        asyncio.run(m.ask("p", [user("x")]))


def test_the_episodes_budget_ends_a_search_and_an_empty_handed_one_ends_the_episode() -> None:
    m = meter(["answer"], Budget(calls=1))
    calls = asyncio.run(m.ask_all([ask("a"), ask("b")]))
    assert len(calls) == 1 and m.exhausted == "episode"
    with pytest.raises(BudgetExceededError, match="budget of 1 calls"):
        m.undecided({})


def test_a_search_without_a_legal_action_is_flagged() -> None:
    m = meter(["nothing legal"])
    asyncio.run(m.ask("p", [user("x")], "explored"))
    decision = m.undecided({"method": "test"})
    assert not decision.valid and decision.trace["fallback"] and "nothing legal" in decision.action.message


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("I say 7", 7),
        ("3 out of 10", 3),
        ("I give it 8/10.", 8),
        ("<think>9</think> 4", 4),
        ("12", None),
        ("", None),
        ("2.5", None),
        ("1" * 50, None),
        ("9.", 9),
    ],
)
def test_ratings_are_read_from_the_end(text: str, number: int | None) -> None:
    assert last_number(text, range(1, 11)) == number


def test_words_are_read_from_the_end() -> None:
    values = {"sure": 20.0, "likely": 1.0}
    assert last_word("Not sure... Likely.", values) == 1.0
    assert last_word("unlikely", values) is None
    assert math.isclose(last_word("SURE", values) or 0, 20.0)
