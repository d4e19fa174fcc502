"""`mem0.Memory` in this process: Qdrant and its history in memory, our model and vectors, nothing sent home.

Imported only where `mem0ai` is installed and used.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable, Sequence
from typing import Any

from agentspec.memory.libraries.base import telemetry_off
from agentspec.registry import SpecError

telemetry_off()
os.environ.setdefault("MEM0_DIR", tempfile.mkdtemp(prefix="mem0-"))  # else it writes into the home folder when imported

import mem0  # noqa: E402
from mem0.configs.base import MemoryConfig  # noqa: E402
from mem0.embeddings.base import EmbeddingBase  # noqa: E402
from mem0.llms.base import LLMBase  # noqa: E402
from mem0.memory import telemetry  # noqa: E402
from qdrant_client import QdrantClient  # noqa: E402


class Model(LLMBase):
    """Answers by a function of the messages."""

    def __init__(self, generate: Callable[[Sequence[dict[str, str]]], str]) -> None:
        super().__init__({"model": "agentspec"})
        self.generate = generate

    def generate_response(self, messages: Any, tools: Any = None, tool_choice: str = "auto", **more: Any) -> str:
        """The answer's text."""
        return self.generate(messages)


class Vectors(EmbeddingBase):
    """Embeds by a function of the text."""

    def __init__(self, embed: Callable[[str], list[float]], dim: int) -> None:
        super().__init__()
        self.config.embedding_dims = dim
        self._embed = embed

    def embed(self, text: str, memory_action: Any = None) -> list[float]:
        """The vector of a text."""
        return self._embed(text)


def local_memory(
    embed: Callable[[str], list[float]],
    dim: int,
    generate: Callable[[Sequence[dict[str, str]]], str] | None = None,
    instructions: str = "",
) -> mem0.Memory:
    """An empty memory in this process.

    Args:
        embed: text -> vector.
        dim: of the vectors.
        generate: messages -> answer; without it only `add(..., infer=False)` works.
        instructions: how facts are extracted; empty: the library's prompt.

    Raises:
        SpecError: a version of the library that is another method, or its telemetry was switched on before.
    """
    version = getattr(mem0, "__version__", "")
    if not version.startswith("1."):
        raise SpecError(f"mem0_library needs mem0ai 1.x, found {version}: pip install 'agentspec-rl[mem0]'")
    if telemetry.MEM0_TELEMETRY:
        raise SpecError("mem0 was imported before with its telemetry on; set MEM0_TELEMETRY=False before importing it")
    store = {"client": QdrantClient(":memory:"), "collection_name": "memories", "embedding_model_dims": dim}
    unused: dict[str, Any] = {"provider": "openai", "config": {"api_key": "unused"}}  # replaced below
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # payload indexes have no effect in local Qdrant
        memory = mem0.Memory(
            MemoryConfig(
                vector_store={"provider": "qdrant", "config": store},
                llm=unused,
                embedder=unused,
                history_db_path=":memory:",
                custom_fact_extraction_prompt=instructions or None,
            )
        )
    memory.embedding_model = Vectors(embed, dim)
    memory.llm = Model(generate or _none)
    return memory


def _none(messages: Sequence[dict[str, str]]) -> str:
    raise RuntimeError("this memory was made without a model: use infer=False")
