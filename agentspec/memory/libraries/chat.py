"""LangChain's side of LangMem: the metered model as a chat model that calls tools, the embedder, the store.

Imported only where `langmem` is installed and used. A model that answers in text calls tools by the protocol that is
written into its system prompt: JSON with the names and arguments. Everything is asynchronous and runs on the loop.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from langchain_core.embeddings import Embeddings
from langchain_core.language_models import BaseChatModel
from langchain_core.messages import AIMessage, BaseMessage, HumanMessage, SystemMessage, ToolMessage
from langchain_core.outputs import ChatGeneration, ChatResult
from langchain_core.runnables import Runnable
from langchain_core.utils.function_calling import convert_to_openai_tool
from langgraph.store.memory import InMemoryStore
from langmem import create_memory_store_manager

from agentspec.llm.base import Message, assistant, system, user
from agentspec.memory.libraries.base import Asker
from agentspec.protocols import Embedder
from agentspec.structured import json_of

PLACE = ("memories",)
ALL = 1_000_000
TOOLS = """
You act by calling tools. Answer with JSON and nothing else:
{"calls": [{"name": the tool's name, "arguments": {its arguments}}]}
Several calls may be made at once; an empty list makes none. The tools, with the JSON schemas of their arguments:
"""


@dataclass(frozen=True)
class ToolCall:
    """One call of a tool, as the model writes it."""

    name: str
    arguments: dict[str, Any] = field(default_factory=dict)


class MeteredChat(BaseChatModel):
    """The episode's model as LangChain's chat model."""

    ask: Any

    @property
    def _llm_type(self) -> str:
        return "agentspec"

    def bind_tools(self, tools: Sequence[Any], *, tool_choice: Any = None, **more: Any) -> Runnable[Any, Any]:
        """Tools become part of the prompt; which of them must be called is left to the model."""
        return self.bind(tools=[convert_to_openai_tool(tool)["function"] for tool in tools])

    def _generate(self, *args: Any, **more: Any) -> ChatResult:
        raise NotImplementedError("the metered model is asked asynchronously: use ainvoke")

    async def _agenerate(
        self, messages: list[BaseMessage], stop: Any = None, run_manager: Any = None, tools: Any = (), **more: Any
    ) -> ChatResult:
        answer = await self.ask("manage", prompt(messages, tools), json_of({"calls": list[ToolCall]}, repairs=0))
        calls = answer.value["calls"] if answer.value is not None else []
        made = [{"name": c.name, "args": c.arguments, "id": f"call_{i}"} for i, c in enumerate(calls)]
        return ChatResult(generations=[ChatGeneration(message=AIMessage(content="", tool_calls=made))])


def prompt(messages: Sequence[BaseMessage], tools: Sequence[Any]) -> list[Message]:
    """LangChain's messages as ours, the tools at the end of one system message."""
    head = "\n\n".join(str(m.text) for m in messages if isinstance(m, SystemMessage))
    listed = "\n".join(json.dumps(tool) for tool in tools)
    turns = [_turn(m) for m in messages if not isinstance(m, SystemMessage)]
    return [system(f"{head}\n{TOOLS}{listed}".strip() if tools else head), *turns]


def _turn(message: BaseMessage) -> Message:
    if isinstance(message, AIMessage):
        calls = [{"name": call["name"], "arguments": call["args"]} for call in message.tool_calls]
        return assistant(json.dumps({"calls": calls}) if calls else str(message.text))
    name = f"Result of {message.name or 'a tool'}: " if isinstance(message, ToolMessage) else ""
    return user(name + str(message.text))


class Vectors(Embeddings):
    """The spec's embedder as LangChain's, without its threads."""

    def __init__(self, embedder: Embedder) -> None:
        self.embedder = embedder

    def embed_documents(self, texts: list[str]) -> list[list[float]]:
        """Vectors of texts."""
        return [[float(x) for x in row] for row in self.embedder.embed(list(texts))]

    def embed_query(self, text: str) -> list[float]:
        """The vector of a text."""
        return self.embed_documents([text])[0]

    async def aembed_documents(self, texts: list[str]) -> list[list[float]]:
        """As `embed_documents`."""
        return self.embed_documents(texts)

    async def aembed_query(self, text: str) -> list[float]:
        """As `embed_query`."""
        return self.embed_query(text)


class Store:
    """LangMem's manager and the store that it writes into.

    Args:
        asker: the metered model.
        embedder: of the memories.
        similar: memories shown to the manager.
        instructions: to the manager; empty: the library's.
    """

    def __init__(self, asker: Asker, embedder: Embedder, similar: int, instructions: str) -> None:
        self.store = InMemoryStore(index={"dims": embedder.dim, "embed": Vectors(embedder)})
        own = {"instructions": instructions} if instructions else {}
        self.manager = create_memory_store_manager(
            MeteredChat(ask=asker), namespace=PLACE, store=self.store, query_limit=similar, enable_deletes=True, **own
        )

    async def manage(self, texts: Sequence[str]) -> None:
        """Let the manager insert, patch and delete."""
        await self.manager.ainvoke({"messages": [HumanMessage(text) for text in texts], "max_steps": 1})

    async def search(self, text: str, k: int) -> list[tuple[str, float]]:
        """The nearest memories, best first."""
        found = await self.store.asearch(PLACE, query=text, limit=k)
        return [(_text(item.value), float(item.score or 0.0)) for item in found]

    def items(self) -> list[list[Any]]:
        """Key and value of every memory, in the order they were written."""
        return [[item.key, item.value] for item in self.store.search(PLACE, limit=ALL)]

    def put(self, items: Sequence[Sequence[Any]]) -> None:
        """Write memories with their keys."""
        for key, value in items:
            self.store.put(PLACE, key, value)


def _text(value: dict[str, Any]) -> str:
    content = value["content"]
    return str(content.get("content", content)) if isinstance(content, dict) else str(content)
