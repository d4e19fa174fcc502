"""`langmem_library`: LangMem's own store manager over LangGraph's in-memory store.

After every `every` steps the manager is shown the new steps and the memories nearest to them and answers with tool
calls that insert, patch and delete (`langmem.create_memory_store_manager`, one round; `trustcall` asks again, at most
twice, where a call does not fit its schema). The model writes tool calls as JSON (`chat`), so any model will do.

Native counterpart: `langmem`, whose `semantic` part this is.
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
    from agentspec.memory.libraries.chat import Store

MOST_CALLS = 4
"""Of a write: the manager's, and those in which `trustcall` has patches of wrong arguments made."""


class LangMemLibrary(LibraryMemory):
    """LangMem, the library.

    Args:
        every: steps between two writes.
        top: memories recalled.
        similar: memories shown to the manager beside new steps.
        instructions: to the manager; empty: the library's.
        step_tokens: most tokens of a step.
        answer_tokens: most tokens of an answer of the model.
        recent: newest steps shown with the memories, where the prompt does not tell them anyway.
    """

    name = "langmem_library"
    package = "langmem"
    declaration = Declaration(
        "the library langmem: a manager that inserts, patches and deletes by tool calls",
        calls=CallProfile(store=(0, MOST_CALLS), episode=(0, MOST_CALLS)),
        purposes={"manage": Purpose("store", '{"calls": [{"name": "Memory", "arguments": {"content": "It is so."}}]}')},
        needs=("embedder",),
        extra="langmem",
        untrainable="its prompts hold random ids, so an episode cannot be played again",
        name=name,
    )

    def __init__(
        self,
        services: Services,
        every: int = 1,
        top: int = 5,
        similar: int = 5,
        instructions: str = "",
        step_tokens: int = 256,
        answer_tokens: int = 512,
        recent: int = 3,
    ) -> None:
        super().__init__(services, every, top, step_tokens, answer_tokens, recent)
        self.similar, self.instructions = similar, instructions

    def open(self) -> Store:
        from agentspec.memory.libraries.chat import Store

        return Store(self.asker, embedder_of(self.services), self.similar, self.instructions)

    async def add(self, steps: Sequence[Step]) -> None:
        await self.client.manage([step.text for step in steps])

    async def search(self, text: str, k: int) -> list[tuple[str, float]]:
        found: list[tuple[str, float]] = await self.client.search(text, k)
        return found

    def export(self) -> list[Any]:
        entries: list[Any] = self.client.items()
        return entries

    def load(self, entries: Sequence[Any]) -> None:
        self.client.put(entries)
