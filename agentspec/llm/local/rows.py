"""One row of the batch per sample: what it still has to read, and what it does with the logits it gets.

A row is a small state machine. ``tokens[computed:]`` has to be read; when that is done the row is given the logits of
the positions from ``wanted`` on and either appends tokens (to be read in turn) or finishes. Sampling inverts the
cumulative distribution at a uniform number from the row's own generator, which is seeded by the request and the
sample's index: what a row samples does not depend on what it is batched with.
"""

from __future__ import annotations

import math
import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch

from agentspec.llm.base import LLMError
from agentspec.llm.constrain import ChoiceTrie
from agentspec.llm.local.cache import Slot
from agentspec.types import Completion, Sampling


@dataclass
class Job:
    """A request as the engine sees it: prompt ids, how to sample, or the continuations to score.

    ``adapter`` names the adapter that answers; the active one if empty.
    """

    episode: str
    prompt: list[int]
    sampling: Sampling
    seed: int = 0
    trie: ChoiceTrie | None = None
    continuations: tuple[tuple[int, ...], ...] = ()
    adapter: str = ""
    completions: tuple[Completion, ...] = ()
    scores: tuple[float, ...] = ()
    cached: int = 0
    error: LLMError | None = None

    def rows(self, stop_ids: frozenset[int], decode: Callable[[Sequence[int]], str]) -> list[Row]:
        """One row per sample or continuation."""
        if self.continuations:
            return [ScoreRow(self, i, c) for i, c in enumerate(self.continuations)]
        if self.trie is not None:
            return [ChoiceRow(self, i, self.trie) for i in range(self.sampling.n)]
        return [FreeRow(self, i, stop_ids, decode) for i in range(self.sampling.n)]


@dataclass
class Row:
    """One sequence of a batch; ``wanted`` is the first position whose logits it needs."""

    job: Job
    index: int
    tokens: list[int] = field(init=False)
    wanted: int = field(init=False)
    slot: Slot = field(init=False)
    computed: int = 0
    known: int = 0
    source: Row | None = None
    done: bool = False

    def __post_init__(self) -> None:
        self.tokens = list(self.job.prompt)
        self.wanted = len(self.tokens) - 1
        self._random = random.Random((self.job.seed + self.index) & (2**63 - 1))

    @property
    def room(self) -> int:
        """Positions the row may need in the end."""
        return len(self.tokens) + 1

    def uniform(self) -> float:
        """The row's next number in [0, 1)."""
        return self._random.random()


class ScoreRow(Row):
    """Adds up the log-probabilities of given tokens."""

    def __init__(self, job: Job, index: int, continuation: Sequence[int]) -> None:
        super().__init__(job, index)
        # The last token predicts nothing that is asked for.
        self.tokens.extend(continuation[:-1])
        self._targets = list(continuation)
        self._logprobs: list[float] = []
        self.done = not continuation

    @property
    def total(self) -> float:
        """Log-probability of the continuation; the same however it was read in pieces."""
        return math.fsum(self._logprobs)

    def feed(self, logits: torch.Tensor) -> None:
        """Logits (n, V) of the next ``n`` wanted positions."""
        n = logits.shape[0]
        targets = torch.tensor(self._targets[:n], device=logits.device)
        # Not `logsumexp`: its exponentials depend, in the last bit, on how many rows there are.
        chosen = logits.log_softmax(-1).gather(1, targets[:, None])[:, 0]
        self._logprobs += chosen.double().tolist()
        del self._targets[:n]
        self.wanted += n
        self.done = not self._targets


class SampleRow(Row, ABC):
    """A row that writes a completion."""

    def __init__(self, job: Job, index: int) -> None:
        super().__init__(job, index)
        self.logprobs: list[float] = []

    @abstractmethod
    def completion(self) -> Completion:
        """What was written, when the row is done."""

    @property
    def written(self) -> list[int]:
        """Tokens of the completion so far."""
        return self.tokens[len(self.job.prompt) :]

    def append(self, token: int, logprob: float) -> None:
        """Add one token; its logits are wanted next."""
        self.tokens.append(token)
        self.logprobs.append(logprob)
        self.wanted = len(self.tokens) - 1


class ChoiceRow(SampleRow):
    """Walks a :class:`~agentspec.llm.constrain.ChoiceTrie`; forced runs are appended without asking the model."""

    def __init__(self, job: Job, index: int, trie: ChoiceTrie) -> None:
        super().__init__(job, index)
        self._trie = trie
        self._node = 0
        self._allowed: list[tuple[int, ...] | None] = []
        self._force()

    @property
    def room(self) -> int:
        """The prompt and the longest choice."""
        return len(self.job.prompt) + self._trie.longest

    @property
    def allowed(self) -> tuple[int, ...]:
        """Ids to choose from now."""
        return self._trie.allowed(self._node)

    def take(self, token: int, logprob: float) -> None:
        """Append a chosen token and what it forces."""
        self._allowed.append(self.allowed)
        self.append(token, logprob)
        self._node = self._trie.advance(self._node, token)
        self._force()

    def _force(self) -> None:
        run, self._node = self._trie.forced(self._node)
        for token in run:
            self._allowed.append((token,))
            self.append(token, 0.0)
        self.done = self._trie.choice(self._node) >= 0

    def completion(self) -> Completion:
        """The finished choice."""
        text = self.job.sampling.choices[self._trie.choice(self._node)]
        return Completion(text, tuple(self.written), tuple(self.logprobs), tuple(self._allowed), "choice")


class FreeRow(SampleRow):
    """Samples until a stop token, a stop string, or ``max_tokens``."""

    def __init__(self, job: Job, index: int, stop_ids: frozenset[int], decode: Callable[[Sequence[int]], str]) -> None:
        super().__init__(job, index)
        self._stop_ids = stop_ids
        self._decode = decode
        self._reason = "length"
        # A stop string of c characters lies within the last 4 c + 4 byte-level tokens, whatever is left of it.
        self._window = 4 * max((len(s) for s in job.sampling.stop), default=0) + 4

    @property
    def room(self) -> int:
        """The prompt and some of the answer; the slot grows when an answer is long."""
        return len(self.tokens) + min(self.job.sampling.max_tokens, 64)

    def take(self, token: int, logprob: float) -> None:
        """Append a sampled token and see whether it ends the completion."""
        self.append(token, logprob)
        if token in self._stop_ids or self._stopped():
            self._reason, self.done = "stop", True
        elif len(self.logprobs) >= self.job.sampling.max_tokens:
            self.done = True

    def _stopped(self) -> bool:
        stop = self.job.sampling.stop
        if not stop:
            return False
        tail = self._decode(self.written[-self._window :])
        return any(s in tail for s in stop)

    def completion(self) -> Completion:
        """The finished completion; its text is cut before the first stop string."""
        ids = self.written
        text = self._decode(ids[:-1] if ids[-1] in self._stop_ids else ids)
        cuts = [text.index(s) for s in self.job.sampling.stop if s in text]
        return Completion(text[: min(cuts, default=len(text))], tuple(ids), tuple(self.logprobs), (), self._reason)
