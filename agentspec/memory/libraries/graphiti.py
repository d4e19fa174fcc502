"""`graphiti_library`: Graphiti (of Zep) over Kuzu in memory. Experimental: its Kuzu back end is deprecated upstream.

After every `every` steps `Graphiti.add_episode` extracts entities and facts, resolves them against the graph and writes
summaries; what is recalled are the facts that its hybrid search (cosine and BM25, reciprocal rank fusion) finds. Two
work-arounds: the four full-text indexes are made by hand, since `build_indices_and_constraints` makes none on Kuzu, and
communities are never built, since its label propagation does not end on two entities that are joined by two facts.

Native counterpart: `zep`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.memory.libraries.base import LibraryMemory
from agentspec.memory.parts.entries import embedder_of
from agentspec.memory.parts.waiting import Step
from agentspec.services import Services

if TYPE_CHECKING:
    from agentspec.memory.libraries.graphiti_graph import Graph

MOST_CALLS = 64
"""Of a write: one to extract entities, one for facts, one to resolve entities, two for each fact, one of summaries."""


class GraphitiLibrary(LibraryMemory):
    """Graphiti, the library.

    Args:
        every: steps between two writes; the steps of a write are one episode of Graphiti's.
        top: facts recalled.
        step_tokens: most tokens of a step.
        answer_tokens: most tokens of an answer of the model.
        recent: newest steps shown with the memories, where the prompt does not tell them anyway.
    """

    name = "graphiti_library"
    package = "graphiti_core"
    declaration = Declaration(
        "the library graphiti-core on Kuzu (experimental): facts with the time they hold, in a graph",
        calls=CallProfile(store=(0, MOST_CALLS), episode=(0, MOST_CALLS)),
        purposes={
            "extract_nodes": Purpose(
                "store",
                '{"extracted_entities": [{"name": "Door", "entity_type_id": 0}, '
                '{"name": "Room", "entity_type_id": 0}]}',
            ),
            "extract_edges": Purpose(
                "store",
                '{"edges": [{"source_entity_name": "Door", "target_entity_name": "Room", "relation_type": "IS_IN", '
                '"fact": "The door is in the room."}]}',
            ),
            "dedupe_nodes": Purpose("store", '{"entity_resolutions": []}'),
            "dedupe_edges": Purpose("store", '{"duplicate_facts": [], "contradicted_facts": []}'),
            "summarise": Purpose("store", '{"summaries": [{"name": "Door", "summary": "It is in the room."}]}'),
            "timestamps": Purpose("store", '{"valid_at": null, "invalid_at": null}'),
        },
        needs=("embedder",),
        extra="graphiti",
        untrainable="its prompts hold the time of day and its ids are random, so an episode cannot be played again",
        name=name,
    )

    def __init__(
        self,
        services: Services,
        every: int = 1,
        top: int = 5,
        step_tokens: int = 256,
        answer_tokens: int = 512,
        recent: int = 3,
    ) -> None:
        super().__init__(services, every, top, step_tokens, answer_tokens, recent)

    def open(self) -> Graph:
        from agentspec.memory.libraries.graphiti_graph import Graph

        return Graph(self.asker, embedder_of(self.services))

    async def add(self, steps: Sequence[Step]) -> None:
        await self.client.add("\n\n".join(step.text for step in steps), steps[-1].time.total)

    async def search(self, text: str, k: int) -> list[tuple[str, float]]:
        found: list[tuple[str, float]] = await self.client.search(text, k)
        return found

    def export(self) -> list[Any]:
        entries: list[Any] = self.client.export()
        return entries

    def load(self, entries: Sequence[Any]) -> None:
        self.client.load(entries)
