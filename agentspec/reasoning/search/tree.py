"""One search tree for all methods: nodes, UCT, selection and back-propagation.

A node stands for an action taken in its parent's state. Its state is filled in when it is visited (RAP) or expanded
(LATS). `returns` holds, for every iteration that passed through, the sum of rewards from this node to the path's end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(eq=False)
class Node:
    """One node.

    Args:
        action: text of the action that leads here; empty at the root.
        parent: where from; `None` at the root.
        state: whatever the method keeps of the state; `None` before it is visited.
        prior: heuristic value before any iteration passed through.
        reward: reward of the step that leads here.
        children: `None` before expansion.
        terminal: nothing follows this state.
        closed: nothing new can be learnt below (terminal, or all children closed).
        source: (call id, completion) that proposed the action.
        note: what the method keeps beside (a thought, an observation).
    """

    action: str = ""
    parent: Node | None = None
    state: Any = None
    prior: float = 0.0
    reward: float = 0.0
    returns: list[float] = field(default_factory=list)
    children: list[Node] | None = None
    terminal: bool = False
    closed: bool = False
    source: tuple[int, int] | None = None
    note: Any = None
    depth: int = field(init=False)

    def __post_init__(self) -> None:
        self.depth = 0 if self.parent is None else self.parent.depth + 1

    @property
    def visits(self) -> int:
        """Iterations that passed through."""
        return len(self.returns)

    @property
    def value(self) -> float:
        """Mean return; the prior before any iteration passed through."""
        return math.fsum(self.returns) / len(self.returns) if self.returns else self.prior

    @property
    def path(self) -> list[Node]:
        """From the root to this node."""
        nodes: list[Node] = [self]
        while nodes[-1].parent is not None:
            nodes.append(nodes[-1].parent)
        return nodes[::-1]

    @property
    def actions(self) -> list[str]:
        """Actions from the root to this node."""
        return [node.action for node in self.path[1:]]

    @property
    def first(self) -> Node:
        """The root's child that this node lies under.

        Raises:
            ValueError: this is the root.
        """
        path = self.path
        if len(path) == 1:
            raise ValueError("the root lies under none of its children")
        return path[1]


def uct(value: float, parent_visits: int, visits: int, weight: float) -> float:
    """Upper confidence bound for trees: `value + weight * sqrt(ln N(parent) / N)`.

    `value` is a mean already and is not divided by the visits again. An unvisited node counts as visited once, its
    prior standing in for the mean (RAP, LATS).
    """
    return value + weight * math.sqrt(math.log(max(1, parent_visits)) / max(1, visits))


def select(root: Node, weight: float, depth: int, *, open_only: bool = False) -> list[Node]:
    """The path from the root by greatest UCT (first on ties) to a node to expand, a terminal one or the depth limit.

    Args:
        weight: exploration weight w.
        depth: deepest node that is selected.
        open_only: pass over closed children (LATS); RAP visits a terminal again.
    """
    path = [root]
    while path[-1].children and not path[-1].terminal and path[-1].depth < depth:
        node = path[-1]
        children = [c for c in node.children or () if not (open_only and c.closed)]
        if not children:
            break
        path.append(max(children, key=lambda c: uct(c.value, node.visits, c.visits, weight)))
    return path


def backpropagate(path: Sequence[Node], tail: float = 0.0) -> float:
    """Append to every node on `path` the sum of rewards from it to the end plus `tail`; returns the root's."""
    total = tail
    for node in reversed(path):
        total += node.reward
        node.returns.append(total)
    return total


def close(node: Node) -> None:
    """Close `node`, and every ancestor whose children are now all closed."""
    node.closed = True
    while node.parent is not None and all(c.closed for c in node.parent.children or ()):
        node = node.parent
        node.closed = True


def nodes_where(root: Node, holds: Callable[[Node], bool]) -> list[Node]:
    """The nodes for which `holds` is true, depth first, children in their order."""
    found, stack = [], [root]
    while stack:
        node = stack.pop()
        if holds(node):
            found.append(node)
        stack += reversed(node.children or [])
    return found


def best_leaf(root: Node, depth: int) -> tuple[float, Node] | None:
    """The visited leaf, terminal or at the depth limit, with the greatest sum of rewards from the root (first on ties).

    `None` if no iteration reached one.
    """
    best: tuple[float, Node] | None = None
    stack: list[tuple[float, Node]] = [(0.0, root)]
    while stack:
        total, node = stack.pop()
        if node.depth and (node.terminal or node.depth >= depth):
            if best is None or total > best[0]:
                best = (total, node)
            continue
        visited = [c for c in node.children or () if c.visits]
        stack += [(total + c.reward, c) for c in reversed(visited)]
    return best
