"""Sequences packed into a trie: what they share is stored once, parents before children."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from agentspec.tokens import shared_prefix
from trainers.tree.flex import block_mask, subtree_ends

NODE_TOKENS = 128
"""Longest node: a longer run of tokens becomes a chain of nodes, so that few queries see keys of their future."""


@dataclass(frozen=True)
class Node:
    """Tokens `start .. end` of the packed row; `path` holds the indices of its ancestors, root first."""

    start: int
    end: int
    path: tuple[int, ...]


@dataclass
class Tree:
    """Sequences packed into a trie.

    `tokens` and `positions` have one entry per unique token; `places[r][p]` is where token p of sequence r is.
    """

    tokens: list[int] = field(default_factory=list)
    positions: list[int] = field(default_factory=list)
    nodes: list[Node] = field(default_factory=list)
    places: list[list[int]] = field(default_factory=list)
    masks: dict[tuple[Any, ...], Any] = field(default_factory=dict, repr=False)

    @functools.cached_property
    def lengths(self) -> list[int]:
        """Tokens per node."""
        return [n.end - n.start for n in self.nodes]

    @functools.cached_property
    def spans(self) -> list[list[tuple[int, int]]]:
        """Per node the places `start .. end` of what its last token sees, in order; what stands in one piece is one."""
        found: list[list[tuple[int, int]]] = []
        for node in self.nodes:
            before = found[node.path[-1]] if node.path else []
            if before and before[-1][1] == node.start:
                found.append([*before[:-1], (before[-1][0], node.end)])
            else:
                found.append([*before, (node.start, node.end)])
        return found

    def block_mask(self, window: int, device: torch.device) -> Any:
        """FlexAttention's mask, built once per window and update."""
        key = (window, device)
        if key not in self.masks:
            paths = [n.path for n in self.nodes]
            ends = subtree_ends([n.start for n in self.nodes], [n.end for n in self.nodes], paths)
            self.masks[key] = block_mask(ends, self.positions, window, device)
        return self.masks[key]


def build_tree(sequences: Sequence[Sequence[int]], node_tokens: int = NODE_TOKENS) -> Tree:
    """Pack token sequences; equal prefixes are stored once, parents before children.

    Sequences may repeat and may be prefixes of each other.
    """
    tree = Tree(places=[[] for _ in sequences])
    order = sorted(range(len(sequences)), key=lambda i: list(sequences[i]))
    # Each entry: sequences (sorted) that agree on their first `depth` tokens, and the path that holds these.
    stack: list[tuple[list[int], int, tuple[int, ...]]] = [(order, 0, ())]
    while stack:
        group, depth, path = stack.pop()
        group = [i for i in group if len(sequences[i]) > depth]
        if not group:
            continue
        branches = _split(group, sequences, depth)
        if len(branches) > 1:
            stack += [(branch, depth, path) for branch in reversed(branches)]
            continue
        first, last = sequences[group[0]], sequences[group[-1]]
        # The group is sorted: what its first and last have in common, all have. One may end before the others.
        end = shared_prefix(first, last, depth, min(depth + node_tokens, *(len(sequences[i]) for i in group)))
        start = len(tree.tokens)
        tree.tokens += first[depth:end]
        tree.positions += range(depth, end)
        tree.nodes.append(Node(start, len(tree.tokens), path))
        for i in group:
            tree.places[i] += range(start, len(tree.tokens))
        stack.append((group, end, (*path, len(tree.nodes) - 1)))
    return tree


def _split(group: list[int], sequences: Sequence[Sequence[int]], depth: int) -> list[list[int]]:
    """Runs of `group` with the same token at `depth`."""
    runs: list[list[int]] = []
    for i in group:
        if runs and sequences[runs[-1][0]][depth] == sequences[i][depth]:
            runs[-1].append(i)
        else:
            runs.append([i])
    return runs
