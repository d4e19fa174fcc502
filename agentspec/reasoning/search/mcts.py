"""Monte-Carlo tree search as RAP does it (Hao et al., 2023; verified against the authors' llm-reasoners 1.0.2).

Select by UCT; expand the leaf: the world model gives its state, then its actions get fast rewards; simulate by
following the greatest fast reward, expanding on the way; back-propagate the sum of rewards from each node to the end.
States are lazy: the world model is asked once per edge, when the edge is first visited.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from agentspec.reasoning.search.tree import Node, backpropagate, select


class Problem(Protocol):
    """What is searched."""

    async def visit(self, node: Node) -> None:
        """Fill in `state`, `reward` and `terminal` of a node, from its parent's state and its action."""
        ...

    async def actions(self, node: Node) -> Sequence[Node]:
        """Children of a visited node, their fast rewards as `prior`."""
        ...


async def search(
    root: Node,
    problem: Problem,
    *,
    iterations: int,
    depth: int,
    weight: float,
    record: list[tuple[float, list[Node]]] | None = None,
) -> None:
    """Grow the tree under `root`, whose state is given.

    Args:
        iterations: paths to sample.
        depth: most steps of a path.
        weight: exploration weight of UCT.
        record: takes (return, path) of every iteration.
    """
    for _ in range(iterations):
        path = select(root, weight, depth)
        if path[-1].state is None or not _ended(path[-1], depth):
            await _expand(path[-1], problem, depth)
            await _simulate(path, problem, depth)
        total = backpropagate(path)
        if record is not None:
            record.append((total, path))
        if not root.children:
            return  # nothing can be done from here


def _ended(node: Node, depth: int) -> bool:
    return node.terminal or node.depth >= depth


async def _expand(node: Node, problem: Problem, depth: int) -> None:
    if node.state is None:
        await problem.visit(node)
    # At the depth limit actions would never be looked at.
    if not _ended(node, depth):
        node.children = list(await problem.actions(node))


async def _simulate(path: list[Node], problem: Problem, depth: int) -> None:
    while not _ended(path[-1], depth) and path[-1].children:
        child = max(path[-1].children, key=lambda c: c.prior)
        path.append(child)
        if child.state is None:
            await _expand(child, problem, depth)
