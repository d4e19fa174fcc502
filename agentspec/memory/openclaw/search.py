"""Search in the logs, and which of what was found deserves to be kept for good.

`memory_search` mixes cosine similarity and BM25 (0.7 and 0.3), over a pool four times as large as what is asked for.
Dreaming scores each log entry by how it was recalled; six signals, each in [0, 1], with fixed weights.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from agentspec.retrieval import Lexical, VectorIndex, mmr
from agentspec.state import Record

VECTOR_WEIGHT, TEXT_WEIGHT = 0.7, 0.3
POOL = 4
RELEVANCE_IN_MMR = 0.7
WEIGHTS = {
    "relevance": 0.30,
    "frequency": 0.24,
    "diversity": 0.15,
    "recency": 0.15,
    "consolidation": 0.10,
    "richness": 0.06,
}
QUERIES_KEPT = 16
_TERM = re.compile(r"[^\W_]+(?:\.\d+)?")


@dataclass(frozen=True)
class Chunk(Record):
    """One entry of a log, and how it has been recalled.

    Args:
        text: as it stands in the log.
        episode: the log it belongs to.
        step: step of the episode it tells of.
        note: written by the model before the conversation was cut, not the record of a step.
        recalls: how often search has shown it.
        relevance: sum of the scores it was shown with.
        queries: digests of the distinct queries that found it, the newest 16.
        episodes: the distinct episodes it was shown in.
        promoted: what it says stands in `MEMORY.md` by now.
    """

    text: str
    episode: int
    step: int
    note: bool = False
    recalls: int = 0
    relevance: float = 0.0
    queries: tuple[str, ...] = ()
    episodes: tuple[int, ...] = ()
    promoted: bool = False

    def recalled(self, score: float, query: str, episode: int) -> Chunk:
        """The same entry, recalled once more."""
        digest = hashlib.blake2b(query.encode("utf-8", "replace"), digest_size=6).hexdigest()
        return replace(
            self,
            recalls=self.recalls + 1,
            relevance=self.relevance + score,
            queries=self.queries if digest in self.queries else (*self.queries, digest)[-QUERIES_KEPT:],
            episodes=self.episodes if episode in self.episodes else (*self.episodes, episode),
        )

    @classmethod
    def load(cls, row: Sequence[Any]) -> Chunk:
        """What `row` gave."""
        *before, queries, episodes, promoted = row
        return replace(cls(*before), queries=tuple(queries), episodes=tuple(episodes), promoted=promoted)


def hybrid(
    vectors: VectorIndex | None, words: Lexical, query: str, k: int, *, diverse: bool = False
) -> list[tuple[int, float]]:
    """The `k` best keys by 0.7 cosine + 0.3 b / (1 + b), where b is the BM25 score; best first.

    Args:
        diverse: choose by maximal marginal relevance (0.7) instead of by score alone.
    """
    scores: dict[int, float] = {}
    if vectors is not None:
        for key, cosine in vectors.search(query, POOL * k):
            scores[key] = VECTOR_WEIGHT * cosine
    for key, bm25 in words.search(query, POOL * k):
        scores[key] = scores.get(key, 0.0) + TEXT_WEIGHT * bm25 / (1.0 + bm25)
    ranking = sorted(scores.items(), key=lambda hit: (-hit[1], hit[0]))
    if diverse and vectors is not None:
        return mmr(ranking, lambda a, b: float(vectors.vector(a) @ vectors.vector(b)), k, relevance=RELEVANCE_IN_MMR)
    return ranking[:k]


def decay(age: float, half_life: float) -> float:
    """Factor of a score whose entry is `age` episodes old: one half per `half_life`; 1 where that is 0 (off).

    >>> decay(30, 30), decay(30, 0)
    (0.5, 1.0)
    """
    return 0.5 ** (age / half_life) if half_life > 0 else 1.0


def signals(chunk: Chunk, episode: int, half_life: float) -> dict[str, float]:
    """The six signals of an entry at episode `episode`, each in [0, 1].

    Mean relevance; log-scaled recalls, full at 10; distinct queries, full at 5; freshness; episodes it came up in, full
    at 3; distinct terms that carry digits or are long, full at 6.
    """
    rich = {t.casefold() for t in _TERM.findall(chunk.text) if len(t) > 6 or any(c.isdigit() for c in t)}
    return {
        "relevance": min(1.0, max(0.0, chunk.relevance / chunk.recalls)) if chunk.recalls else 0.0,
        "frequency": min(1.0, math.log1p(chunk.recalls) / math.log1p(10)),
        "diversity": min(1.0, len(chunk.queries) / 5),
        "recency": decay(episode - chunk.episode, half_life),
        "consolidation": min(1.0, len(chunk.episodes) / 3),
        "richness": min(1.0, len(rich) / 6),
    }


def dream_score(chunk: Chunk, episode: int, half_life: float) -> float:
    """The weighted sum of `signals`, in [0, 1]."""
    found = signals(chunk, episode, half_life)
    return sum(weight * found[name] for name, weight in WEIGHTS.items())


def kept_share(before: dict[str, str], after: dict[str, str]) -> float:
    """Share of the rules of `before` whose name is in `after`; 1 where there were none."""
    return sum(name in after for name in before) / len(before) if before else 1.0
