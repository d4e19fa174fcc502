"""Graphiti in this process: a graph in memory, our model, our vectors, nothing sent home.

Imported only where `graphiti-core[kuzu]` is installed and used. Steps have no time of day: step `n` of the run is taken
to be `n` minutes after a fixed day, so that Graphiti's times order facts as they were seen.
"""

from __future__ import annotations

import asyncio
import json
import threading
import warnings
from collections.abc import Coroutine, Iterable, Sequence
from contextvars import ContextVar
from datetime import UTC, datetime, timedelta
from typing import Any, TypeVar

from agentspec.llm.base import Message, system, user
from agentspec.memory.libraries.base import Asker, telemetry_off
from agentspec.protocols import Embedder
from agentspec.structured import json_of

telemetry_off()

from graphiti_core import Graphiti  # noqa: E402
from graphiti_core.cross_encoder.client import CrossEncoderClient  # noqa: E402
from graphiti_core.driver.driver import GraphProvider  # noqa: E402
from graphiti_core.driver.kuzu_driver import KuzuDriver  # noqa: E402
from graphiti_core.edges import EntityEdge, EpisodicEdge  # noqa: E402
from graphiti_core.embedder.client import EmbedderClient  # noqa: E402
from graphiti_core.errors import GroupsEdgesNotFoundError  # noqa: E402
from graphiti_core.graph_queries import get_fulltext_indices  # noqa: E402
from graphiti_core.helpers import get_default_group_id  # noqa: E402
from graphiti_core.llm_client.client import LLMClient  # noqa: E402
from graphiti_core.nodes import EntityNode, EpisodeType, EpisodicNode  # noqa: E402

T = TypeVar("T")

BEGINNING = datetime(2000, 1, 1, tzinfo=UTC)
GROUP = get_default_group_id(GraphProvider.KUZU)
TABLES: dict[str, Any] = {"episode": EpisodicNode, "entity": EntityNode, "fact": EntityEdge, "mention": EpisodicEdge}
"""What is exported, in the order in which it can be written again; vectors are made anew."""

VECTORS = {"name_embedding", "fact_embedding"}


class UnreadableError(ValueError):
    """An answer that is no JSON object."""


class Model(LLMClient):
    """The episode's model as Graphiti's client; a call's purpose is the group of its prompt."""

    def __init__(self, ask: Asker) -> None:
        super().__init__(None)
        self.ask = ask
        self._prompt: ContextVar[str] = ContextVar("prompt", default="")

    async def generate_response(self, messages: Any, *args: Any, **more: Any) -> dict[str, Any]:
        """As the library's, which does not hand the prompt's name on."""
        self._prompt.set(str(more.get("prompt_name") or ""))
        answer: dict[str, Any] = await super().generate_response(messages, *args, **more)
        return answer

    async def _generate_response(self, messages: Any, *args: Any, **more: Any) -> dict[str, Any]:
        parse = json_of(dict[str, Any], repairs=0)
        purpose = purpose_of(self._prompt.get())
        answer = await self.ask(purpose, [_message(m.role, m.content) for m in messages], parse)
        if answer.value is None:
            raise UnreadableError(f"{purpose}: the answer is {answer.problem or 'empty'}")
        return dict(answer.value)


def purpose_of(prompt: str) -> str:
    """`extract_edges.edge` is `extract_edges`; summaries and times of facts are told apart from extraction."""
    group, _, name = prompt.partition(".")
    if "summar" in prompt:
        return "summarise"
    return "timestamps" if "timestamps" in name else group or "other"


def _message(role: str, text: str) -> Message:
    return (system if role == "system" else user)(text)


class Vectors(EmbedderClient):
    """The spec's embedder."""

    def __init__(self, embedder: Embedder) -> None:
        self.embedder = embedder

    async def create(self, input_data: Any) -> list[float]:
        """The vector of a text (of the first, where there are several)."""
        return (await self.create_batch([input_data] if isinstance(input_data, str) else list(input_data)[:1]))[0]

    async def create_batch(self, input_data_list: list[str]) -> list[list[float]]:
        """Vectors of texts."""
        return [[float(x) for x in row] for row in self.embedder.embed(list(input_data_list))]


class NoReranker(CrossEncoderClient):
    """Reciprocal rank fusion needs none; the library builds OpenAI's if it is given none."""

    async def rank(self, query: str, passages: list[str]) -> list[tuple[str, float]]:
        """The passages as they are."""
        return [(passage, 0.0) for passage in passages]


class Graph:
    """One memory's graph.

    Args:
        asker: the metered model.
        embedder: of names and facts.
    """

    def __init__(self, asker: Asker, embedder: Embedder) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            self.driver = KuzuDriver(":memory:")
        self.vectors = Vectors(embedder)
        self.graphiti = Graphiti(
            graph_driver=self.driver,
            llm_client=Model(asker),
            embedder=self.vectors,
            cross_encoder=NoReranker(),
            max_coroutines=1,  # calls in an order that does not depend on chance
        )
        _elsewhere(self._run(get_fulltext_indices(GraphProvider.KUZU)))

    async def _run(self, queries: Iterable[str]) -> None:
        for query in queries:
            await self.driver.execute_query(query)

    async def add(self, text: str, minute: int) -> None:
        """Ingest an episode of Graphiti's."""
        await self.graphiti.add_episode(
            name=f"step {minute}",
            episode_body=text,
            source_description="steps of an agent",
            reference_time=BEGINNING + timedelta(minutes=minute),
            source=EpisodeType.text,
        )

    async def search(self, text: str, k: int) -> list[tuple[str, float]]:
        """The facts nearest to a text, best first, with the rank's reciprocal for a score."""
        edges = await self.graphiti.search(text, num_results=k)
        return [(_told(edge), 1.0 / (1 + rank)) for rank, edge in enumerate(edges)]

    def export(self) -> list[list[Any]]:
        """Kind and fields of every node and edge."""
        return _elsewhere(self._export())

    async def _export(self) -> list[list[Any]]:
        found = []
        for kind, table in TABLES.items():
            try:
                rows = await table.get_by_group_ids(self.driver, [GROUP])
            except GroupsEdgesNotFoundError:
                rows = []
            found += [[kind, row.model_dump(mode="json", exclude=VECTORS)] for row in rows]
        return sorted(found, key=lambda e: (list(TABLES).index(e[0]), e[1]["created_at"], e[1]["uuid"]))

    def load(self, entries: Sequence[Sequence[Any]]) -> None:
        """Write what `export` gave."""
        _elsewhere(self._load(entries))

    async def _load(self, entries: Sequence[Sequence[Any]]) -> None:
        for kind, fields in entries:
            row = TABLES[kind].model_validate_json(json.dumps(fields))
            if kind == "entity":
                await row.generate_name_embedding(self.vectors)
            elif kind == "fact":
                await row.generate_embedding(self.vectors)
            await row.save(self.driver)


def _told(edge: EntityEdge) -> str:
    return str(edge.fact) + (" (no longer so)" if edge.invalid_at or edge.expired_at else "")


def _elsewhere(work: Coroutine[Any, Any, T]) -> T:
    """The result of a coroutine that asks no model, in a loop of its own: snapshots are taken from within the loop."""
    result: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            result.append(asyncio.run(work))
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run, name="agentspec-graph")
    thread.start()
    thread.join()
    if errors:
        raise errors[0]
    return result[0]
