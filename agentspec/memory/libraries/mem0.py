"""`mem0_library`: `mem0ai`, version 1 (the paper's ADD, UPDATE, DELETE and NONE), over its local Qdrant in memory.

After every `every` steps `Memory.add` extracts facts in one call and decides about them, beside the five nearest
memories of each, in a second. It runs in a thread of its own (`agentspec.memory.libraries.bridge`). Version 2 of the
library only adds, with a prompt of about 9,000 tokens; it is another method, and refused.

Native counterpart: `mem0`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message, system, user
from agentspec.memory.libraries.base import LibraryMemory
from agentspec.memory.libraries.bridge import Bridge
from agentspec.memory.parts.entries import embedder_of
from agentspec.memory.parts.waiting import Step
from agentspec.services import Services

if TYPE_CHECKING:
    from mem0 import Memory

WHO = "agent"
ALL = 1_000_000


class Mem0Library(LibraryMemory):
    """Mem0, the library.

    Args:
        every: steps between two writes.
        top: memories recalled.
        instructions: how facts are extracted; empty: the library's prompt, which is about a person's preferences.
        step_tokens: most tokens of a step.
        answer_tokens: most tokens of an answer of the model.
        recent: newest steps shown with the memories, where the prompt does not tell them anyway.
    """

    name = "mem0_library"
    package = "mem0"
    declaration = Declaration(
        "the library mem0ai 1.x: facts that the model adds, updates and deletes",
        calls=CallProfile(store=(0, 2), episode=(0, 2)),
        purposes={
            "extract": Purpose("store", '{"facts": ["The door is open."]}'),
            "update": Purpose("store", '{"memory": [{"id": "0", "text": "The door is open.", "event": "ADD"}]}'),
        },
        needs=("embedder",),
        extra="mem0",
        untrainable="its prompts hold the date, so an episode cannot be played again",
        name=name,
        aliases=("mem0ai",),
    )

    def __init__(
        self,
        services: Services,
        every: int = 1,
        top: int = 5,
        instructions: str = "",
        step_tokens: int = 256,
        answer_tokens: int = 512,
        recent: int = 3,
    ) -> None:
        super().__init__(services, every, top, step_tokens, answer_tokens, recent)
        self.instructions = instructions
        self.bridge = Bridge()

    def open(self) -> Memory:
        from agentspec.memory.libraries.mem0_store import local_memory

        embedder = embedder_of(self.services)

        def embed(text: str) -> list[float]:
            return self.bridge.call(lambda: [float(x) for x in embedder.embed([text])[0]])

        return local_memory(embed, embedder.dim, self._generate, self.instructions)

    def _generate(self, messages: Sequence[dict[str, str]]) -> str:
        """What the library asks, from its thread: a system prompt comes with extraction alone."""
        purpose = "extract" if messages[0]["role"] == "system" else "update"
        answer = self.bridge.ask(self.asker(purpose, [_message(m) for m in messages]))
        return str(answer.value or "")

    async def add(self, steps: Sequence[Step]) -> None:
        messages = [{"role": "user", "content": step.text} for step in steps]
        memory = self.client
        await self.bridge.run(lambda: memory.add(messages, user_id=WHO))

    async def search(self, text: str, k: int) -> list[tuple[str, float]]:
        memory = self.client
        found = await self.bridge.run(lambda: memory.search(text, user_id=WHO, limit=k))
        return [(item["memory"], float(item["score"])) for item in found["results"]]

    def export(self) -> list[Any]:
        points, _ = self.client.vector_store.list(limit=ALL)
        return sorted([[str(p.id), p.payload] for p in points], key=lambda e: (e[1].get("created_at", ""), e[0]))

    def load(self, entries: Sequence[Any]) -> None:
        memory = self.client
        for key, payload in entries:
            vector = memory.embedding_model.embed(payload["data"], "add")
            memory.vector_store.insert([vector], [payload], [key])


def _message(message: dict[str, str]) -> Message:
    return (system if message["role"] == "system" else user)(message["content"])
