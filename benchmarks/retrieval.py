"""Retrieval: adding and searching, at the sizes memories have and far beyond, beside ChromaDB where it is installed.

    python -m benchmarks.retrieval [--json] [--sizes 100 1000 10000 100000] [--searches 200] [--dim 384]

Entries are sentences of a courier's day with random numbers and places; their vectors come from feature hashing, so
that the time of an embedding model, which is the same whatever stores the vectors, is left out. `vector`, `lexical` and
`fused` (both, by reciprocal rank) are this project's; `chromadb` is an ephemeral in-process collection with the same
vectors, cosine distance and its default HNSW settings, telemetry off. Searches ask for ten entries. Printed per size:
median and 99th percentile in milliseconds of one search and of one added entry; `ratio_to_chromadb` is its median
search over that of `vector` (above 1: ours is faster). `recall_at_10` of ChromaDB is against the exact answer, which
ours gives by construction. Every word of these queries stands in a large share of the entries: the dearest case for
`lexical`, whose time grows with the number of entries that match at all.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

from agentspec.embedding import CachedEmbedder, HashEmbedder
from agentspec.retrieval import Lexical, VectorIndex, reciprocal_rank_fusion

K = 10
PLACES = ("restaurant", "charging station", "bus stop", "store", "hospital", "customer", "rest area", "rental")
EVENTS = ("picked up", "delivered", "missed", "charged", "waited for", "bought", "accepted", "dropped off", "rode to")
THINGS = ("a pizza", "an ice pack", "order", "two drinks", "a hot soup", "an energy drink", "a scooter", "the salad")


def sentence(rng: random.Random) -> str:
    """One entry of a courier's memory."""
    return (
        f"step {rng.randrange(500)}: {rng.choice(EVENTS)} {rng.choice(THINGS)} {rng.randrange(1000)} at the "
        f"{rng.choice(PLACES)} {rng.randrange(60)}, battery {rng.randrange(100)} %, earned {rng.randrange(900) / 100} $"
    )


def timed(calls: Sequence[Callable[[], Any]]) -> dict[str, float]:
    """Median and 99th percentile of `calls`, each timed alone, in milliseconds."""
    times = []
    for call in calls:
        began = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - began))
    ordered = sorted(times)
    return {"p50_ms": statistics.median(ordered), "p99_ms": ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))]}


def ours(entries: Sequence[str], queries: Sequence[str], embedder: CachedEmbedder) -> dict[str, Any]:
    """This project's three ways to search the same entries."""
    vector, lexical = VectorIndex(embedder), Lexical()
    embedder.embed([*entries, *queries])
    for key, text in enumerate(entries):
        vector.put(key, text)
        lexical.put(key, text)
    vector.search(queries[0], K)  # the first search builds the matrix

    def fused(query: str) -> list[tuple[int, float]]:
        return reciprocal_rank_fusion([vector.search(query, 4 * K), lexical.search(query, 4 * K)])[:K]

    count = len(entries)
    fresh = [f"{query} again" for query in queries]
    embedder.embed(fresh)

    def add(index: Any, key: int, text: str) -> Callable[[], Any]:
        def call() -> None:
            index.put(key, text)
            if index is vector:
                index.vector(key)  # the matrix takes it in

        return call

    found = {
        name: {"search": timed([lambda q=q, f=f: f(q) for q in queries])}  # type: ignore[misc]
        for name, f in (
            ("vector", lambda q: vector.search(q, K)),
            ("lexical", lambda q: lexical.search(q, K)),
            ("fused", fused),
        )
    }
    for name, index in (("vector", vector), ("lexical", lexical)):
        found[name]["add"] = timed([add(index, count + i, text) for i, text in enumerate(fresh)])
    return found


def chroma(entries: Sequence[str], queries: Sequence[str], embedder: CachedEmbedder) -> dict[str, Any] | None:
    """ChromaDB on the same vectors, or `None` where it is not installed."""
    try:
        import chromadb
        from chromadb.config import Settings
    except ImportError:
        return None
    client = chromadb.EphemeralClient(Settings(anonymized_telemetry=False))
    name = f"entries-{len(entries)}"
    collection = client.create_collection(name, metadata={"hnsw:space": "cosine"}, embedding_function=None)
    vectors = embedder.embed(list(entries))
    for start in range(0, len(entries), 5000):
        part = slice(start, min(len(entries), start + 5000))
        ids = [str(i) for i in range(part.start, part.stop)]
        collection.add(ids=ids, embeddings=vectors[part], documents=list(entries[part]))
    asked = [embedder.embed([q])[0] for q in queries]
    answers: list[list[str]] = []

    def search(vector: Any) -> Callable[[], Any]:
        return lambda: answers.append(collection.query(query_embeddings=[vector], n_results=K)["ids"][0])

    searched = timed([search(v) for v in asked])
    exact = VectorIndex(embedder)
    for key, text in enumerate(entries):
        exact.put(key, text)
    shares = []
    for query, got in zip(queries, answers, strict=True):
        scores = exact.scores(query)
        worst = sorted(scores, reverse=True)[min(K, len(scores)) - 1]
        shares.append(sum(scores[int(i)] >= worst - 1e-6 for i in got) / max(1, len(got)))
    added = timed(
        [
            lambda i=i, v=v, q=q: collection.add(ids=[f"new-{i}"], embeddings=[v], documents=[q])  # type: ignore[misc]
            for i, (v, q) in enumerate(zip(asked, queries, strict=True))
        ]
    )
    client.delete_collection(name)
    return {"search": searched, "add": added, "recall_at_10": statistics.fmean(shares)}


def measure(sizes: Sequence[int], searches: int, dim: int) -> dict[str, Any]:
    """All figures, by size."""
    results: dict[str, Any] = {}
    for size in sizes:
        rng = random.Random(size)
        entries, queries = [sentence(rng) for _ in range(size)], [sentence(rng) for _ in range(searches)]
        embedder = CachedEmbedder(HashEmbedder(dim), capacity=10 * (size + searches))
        row = ours(entries, queries, embedder)
        other = chroma(entries, queries, embedder)
        if other is not None:
            row["chromadb"] = other
            row["ratio_to_chromadb"] = other["search"]["p50_ms"] / row["vector"]["search"]["p50_ms"]
        results[str(size)] = row
    return results


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "", allow_abbrev=False)
    parser.add_argument("--sizes", type=int, nargs="+", default=[100, 1000, 10_000, 100_000])
    parser.add_argument("--searches", type=int, default=200)
    parser.add_argument("--dim", type=int, default=384)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    results = measure(args.sizes, args.searches, args.dim)
    if args.json:
        print(json.dumps(results))
        return
    for size, row in results.items():
        print(f"{size} entries")
        for name in ("vector", "lexical", "fused", "chromadb"):
            for what in ("search", "add"):
                if what in row.get(name, {}):
                    figures = row[name][what]
                    print(f"  {name:<9}{what:<7} p50 {figures['p50_ms']:8.3f} ms   p99 {figures['p99_ms']:8.3f} ms")
        if "chromadb" in row:
            recall = row["chromadb"]["recall_at_10"]
            print(f"  ratio_to_chromadb {row['ratio_to_chromadb']:.2f}, its recall@10 {recall:.3f}")
        else:
            print("  chromadb is not installed here: not compared")


if __name__ == "__main__":
    main()
