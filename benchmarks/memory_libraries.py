"""Memory libraries on the sentences and vectors of `benchmarks.memory`, where they are installed, beside our own index.

Each is measured as what a memory stores in: no language model is asked, and vectors are ready. What a library cannot do
(a snapshot) is left out of its row.
"""

from __future__ import annotations

import random
import statistics
import time
from collections.abc import Callable
from typing import Any

from agentspec.embedding import CachedEmbedder, HashEmbedder
from agentspec.retrieval import VectorIndex
from benchmarks.retrieval import sentence

K = 10
Measured = Callable[[int, int, int], "dict[str, Any] | None"]


def sentences(size: int, repeats: int) -> tuple[list[str], list[str], list[str]]:
    """Entries, queries, and entries that are added one by one."""
    rng = random.Random(size)
    texts = [sentence(rng) for _ in range(size + 2 * repeats)]
    return texts[:size], texts[size : size + repeats], texts[size + repeats :]


Timed = tuple[float, float]


def timed(work: Callable[[], Any]) -> Timed:
    """Milliseconds of one call: by the clock, and of the processor, which a busy machine changes little."""
    began, used = time.perf_counter(), time.process_time()
    work()
    return 1e3 * (time.perf_counter() - began), 1e3 * (time.process_time() - used)


def row(retrieved: list[Timed], stored: list[Timed], size: int) -> dict[str, Any]:
    """Figures under the names of `benchmarks.memory`."""
    found: dict[str, Any] = {"filled": size}
    for name, times in (("retrieve", retrieved), ("store", stored)):
        ordered = sorted(clock for clock, _ in times)
        found[f"{name}_p50_ms"] = statistics.median(ordered)
        found[f"{name}_p99_ms"] = ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))]
        found[f"{name}_cpu_p50_ms"] = statistics.median(processor for _, processor in times)
    return found


def vector_index(size: int, repeats: int, dim: int) -> dict[str, Any]:
    """What this package's memories store in: exact search over one matrix."""
    entries, queries, more = sentences(size, repeats)
    embedder = CachedEmbedder(HashEmbedder(dim), 10 * (size + repeats))
    embedder.embed([*entries, *queries, *more])
    index = VectorIndex(embedder)
    for i, text in enumerate(entries):
        index.put(i, text)
    index.search(queries[0], K)  # what `put` leaves to the next search is done
    retrieved = [timed(lambda q=q: index.search(q, K)) for q in queries]  # type: ignore[misc]
    stored = [timed(lambda i=i, t=t: _put(index, size + i, t)) for i, t in enumerate(more)]  # type: ignore[misc]
    return row(retrieved, stored, size)


def _put(index: VectorIndex, key: int, text: str) -> None:
    index.put(key, text)
    index.vector(key)  # not left to the next search


def chromadb(size: int, repeats: int, dim: int) -> dict[str, Any] | None:
    """An ephemeral collection, cosine distance, default HNSW settings."""
    try:
        import chromadb as library
        from chromadb.config import Settings
    except ImportError:
        return None
    entries, queries, more = sentences(size, repeats)
    embedder = CachedEmbedder(HashEmbedder(dim), 10 * (size + repeats))
    client = library.EphemeralClient(Settings(anonymized_telemetry=False))
    name = f"memory-{size}"
    collection = client.create_collection(name, metadata={"hnsw:space": "cosine"}, embedding_function=None)
    for start in range(0, size, 5000):
        part = entries[start : start + 5000]
        ids = [str(start + i) for i in range(len(part))]
        collection.add(ids=ids, embeddings=embedder.embed(part), documents=part)
    asked, added = embedder.embed(queries), embedder.embed(more)
    retrieved = [timed(lambda v=v: collection.query(query_embeddings=[v], n_results=K)) for v in asked]  # type: ignore[misc]
    stored = [
        timed(lambda i=i, v=v: collection.add(ids=[f"new-{i}"], embeddings=[v], documents=[more[i]]))  # type: ignore[misc]
        for i, v in enumerate(added)
    ]
    client.delete_collection(name)
    return row(retrieved, stored, size)


def langmem(size: int, repeats: int, dim: int) -> dict[str, Any] | None:
    """The in-memory store that LangMem's managers write into (LangGraph's, with an index over the text)."""
    try:
        import langmem  # noqa: F401  # what is measured is the store that it uses
        from langgraph.store.memory import InMemoryStore
    except ImportError:
        return None
    entries, queries, more = sentences(size, repeats)
    embedder = CachedEmbedder(HashEmbedder(dim), 10 * (size + repeats))
    embedder.embed([*entries, *queries, *more])  # the time of an embedder is left out

    def embed(texts: list[str]) -> list[list[float]]:
        return embedder.embed(list(texts)).tolist()

    store = InMemoryStore(index={"dims": dim, "embed": embed, "fields": ["text"]})
    for i, text in enumerate(entries):
        store.put(("memories",), str(i), {"text": text})
    retrieved = [timed(lambda q=q: store.search(("memories",), query=q, limit=K)) for q in queries]  # type: ignore[misc]
    stored = [
        timed(lambda i=i, t=t: store.put(("memories",), f"new-{i}", {"text": t}))  # type: ignore[misc]
        for i, t in enumerate(more)
    ]
    return row(retrieved, stored, size)


def mem0ai(size: int, repeats: int, dim: int) -> dict[str, Any] | None:
    """Mem0's `add(infer=False)` and `search` over its local Qdrant in memory, telemetry off."""
    try:
        from agentspec.memory.libraries.mem0_store import local_memory
    except ImportError:
        return None
    embedder = CachedEmbedder(HashEmbedder(dim), 10 * (size + repeats))
    memory = local_memory(lambda text: embedder.embed([text])[0].tolist(), dim)
    entries, queries, more = sentences(size, repeats)
    embedder.embed([*entries, *queries, *more])
    for text in entries:
        memory.add(text, user_id="agent", infer=False)
    retrieved = [timed(lambda q=q: memory.search(q, user_id="agent", limit=K)) for q in queries]  # type: ignore[misc]
    stored = [timed(lambda t=t: memory.add(t, user_id="agent", infer=False)) for t in more]  # type: ignore[misc]
    return row(retrieved, stored, size)


LIBRARIES: dict[str, Measured] = {
    "vector_index": vector_index,
    "chromadb": chromadb,
    "langmem_store": langmem,
    "mem0ai": mem0ai,
}
"""Name in the table -> (entries, repeats, dimensions) -> figures, or `None` where it is not installed."""

__all__ = ["LIBRARIES"]
