"""Constrained decoding: a token trie over the texts a completion may be.

Every choice becomes the path of its tokens followed by the end-of-turn token, so that a choice may be a prefix of
another ("go", "go north"): ending the turn is then one of the allowed tokens. A walk from the root to a leaf spells
one choice. At a node with a single child the next token is *forced*: it carries no information, has log-probability 0
under the constrained distribution, and a whole run of them needs no model at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass
class _Node:
    children: dict[int, int] = field(default_factory=dict)
    choice: int = -1


class ChoiceTrie:
    """The token trie of ``sequences``; nodes are numbers, the root is 0.

    Args:
        sequences: token ids of each choice, without the end of turn. Equal sequences are one choice (the first).
        end: the end-of-turn token that closes every choice.

    Raises:
        ValueError: there is no choice, or a choice contains ``end``.
    """

    def __init__(self, sequences: Sequence[Sequence[int]], end: int) -> None:
        if not sequences:
            raise ValueError("constrained decoding got no choices; give at least one text")
        self.end = end
        self._nodes = [_Node()]
        for number, tokens in enumerate(sequences):
            if end in tokens:
                raise ValueError(f"choice {number} contains the end-of-turn token {end}; remove it from the text")
            node = 0
            for token in (*tokens, end):
                node = self._child(node, token)
            if self._nodes[node].choice < 0:
                self._nodes[node].choice = number
        self._allowed = tuple(tuple(sorted(n.children)) for n in self._nodes)
        self.longest = max(len(s) for s in sequences) + 1
        """Tokens of the longest choice, end of turn included."""

    def _child(self, node: int, token: int) -> int:
        found = self._nodes[node].children.get(token)
        if found is None:
            found = self._nodes[node].children[token] = len(self._nodes)
            self._nodes.append(_Node())
        return found

    def __len__(self) -> int:
        return len(self._nodes)

    def allowed(self, node: int) -> tuple[int, ...]:
        """Token ids that may follow, ascending; empty at a leaf."""
        return self._allowed[node]

    def advance(self, node: int, token: int) -> int:
        """The node after ``token``.

        Raises:
            ValueError: the token is not allowed here.
        """
        child = self._nodes[node].children.get(token)
        if child is None:
            raise ValueError(f"token {token} is not allowed here; allowed: {self._allowed[node]}")
        return child

    def forced(self, node: int) -> tuple[tuple[int, ...], int]:
        """The run of forced tokens from ``node``, and the branching node or leaf it leads to."""
        tokens: list[int] = []
        while len(self._allowed[node]) == 1:
            token = self._allowed[node][0]
            tokens.append(token)
            node = self._nodes[node].children[token]
        return tuple(tokens), node

    def choice(self, node: int) -> int:
        """Number of the choice that ends at ``node``, -1 if it is no leaf."""
        return self._nodes[node].choice

    def walk(self, tokens: Sequence[int]) -> tuple[tuple[int, ...], ...]:
        """The allowed ids before each of ``tokens``, from the root.

        Raises:
            ValueError: one of the tokens is not allowed in its place.
        """
        node, path = 0, []
        for token in tokens:
            path.append(self._allowed[node])
            node = self.advance(node, token)
        return tuple(path)
