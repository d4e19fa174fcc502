"""The trained calls of an episode as the fewest token sequences.

A call whose prompt extends a sequence is appended to it: mask 0 on what the environment and the scaffold wrote, 1 on
what the policy chose. Otherwise a new sequence starts. So an append-only context gives one sequence per episode,
periodic summaries one per segment, and a scaffold that rebuilds its prompt one per call. Nothing downstream knows which
scaffold ran.

A token is trained if the policy *chose* it. A token that a constraint forced has probability 1 and no gradient; it is
context, and it does not count in a loss denominator.
"""

from __future__ import annotations

from collections.abc import Sequence as SequenceOf
from dataclasses import dataclass, field

from agentspec.tags import matches
from agentspec.trajectory import Trajectory
from agentspec.types import Completion, Credit, LLMCall


@dataclass(frozen=True)
class TrainFilter:
    """Which completions are trained.

    Args:
        patterns: shell patterns over `module/purpose` paths; a pattern without `/` matches any purpose.
        credits: credits that are trained.
        mask_truncated: patterns of calls whose completions are context only when they hit their length limit (a
            summary cut off in the middle, say).
    """

    patterns: tuple[str, ...] = ("reasoning.*",)
    credits: tuple[Credit, ...] = ("executed",)
    mask_truncated: tuple[str, ...] = ()

    def matches(self, path: str) -> bool:
        """Whether calls of `path` may be trained."""
        return matches(path, self.patterns)

    def completions(self, call: LLMCall) -> list[Completion]:
        """The trained completions of `call`."""
        if not self.matches(call.tag.path):
            return []
        cut = matches(call.tag.path, self.mask_truncated)
        return [
            c
            for c in call.completions
            if c.credit in self.credits and c.token_ids and not (cut and c.finish_reason == "length")
        ]


@dataclass
class TokenSequence:
    """One training row.

    All lists have one entry per token. `logprobs` are those of the sampling distribution (0 where `mask` is 0),
    `temperatures` the sampling temperature, `calls` the id of the call that wrote the token (-1: nobody's choice).
    `allowed` maps a position to the ids its constraint left, `paths` a call's id to its `module/purpose`.
    """

    tokens: list[int] = field(default_factory=list)
    mask: list[int] = field(default_factory=list)
    logprobs: list[float] = field(default_factory=list)
    temperatures: list[float] = field(default_factory=list)
    calls: list[int] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    allowed: dict[int, tuple[int, ...]] = field(default_factory=dict)
    paths: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.tokens)

    @property
    def trained(self) -> int:
        """Number of trained tokens."""
        return sum(self.mask)

    def extend_context(self, tokens: SequenceOf[int]) -> None:
        """Append tokens that nobody is credited for."""
        n = len(tokens)
        self.tokens += tokens
        self.mask += [0] * n
        self.logprobs += [0.0] * n
        self.temperatures += [1.0] * n
        self.calls += [-1] * n
        self.steps += [-1] * n

    def extend_sampled(self, call: LLMCall, completion: Completion) -> None:
        """Append a `completion` of `call`; tokens that were a choice are trained.

        Raises:
            ValueError: the backend recorded no log-probabilities for it.
        """
        ids, start = completion.token_ids, len(self.tokens)
        if len(completion.logprobs) != len(ids):
            raise ValueError(
                f"call {call.id} ({call.tag.path}) of episode {call.tag.episode} has {len(ids)} sampled tokens and "
                f"{len(completion.logprobs)} log-probabilities; training needs a backend that records both"
            )
        allowed = completion.allowed or (None,) * len(ids)
        self.paths[call.id] = call.tag.path
        for position, (token, logprob, choice) in enumerate(zip(ids, completion.logprobs, allowed, strict=True), start):
            free = choice is None or len(choice) > 1
            self.tokens.append(token)
            self.mask.append(int(free))
            self.logprobs.append(logprob if free else 0.0)
            self.temperatures.append(call.sampling.temperature)
            self.calls.append(call.id)
            self.steps.append(call.tag.step)
            if choice is not None and free:
                self.allowed[position] = choice


Advantage = float | tuple[float, ...]
"""A number, or one per token of a row."""


@dataclass(frozen=True)
class Row:
    """One sequence with its advantage: a number, or one per token for estimators per step."""

    sequence: TokenSequence
    advantage: Advantage
    episode: int

    @property
    def zero_gradient(self) -> bool:
        """Whether the row has no policy gradient: nothing trained, or advantage zero throughout."""
        values = (self.advantage,) if isinstance(self.advantage, (int, float)) else self.advantage
        return self.sequence.trained == 0 or not any(values)


def build_sequences(trajectory: Trajectory, train: TrainFilter | None = None) -> list[TokenSequence]:
    """The training rows of one episode, each with at least one trained token.

    A call extends the longest sequence that its prompt contains as a prefix. Two completions of one prompt never share
    a row: the second starts its own. A call made after the last step (`tag.step` is the number of transitions, a
    memory that stores the last one, say) earns nothing in this episode and is left out; calls of
    helper models (the spec's `roles`) are never trained.
    """
    rows: list[TokenSequence] = []
    for call, completion in trained_completions(trajectory, train or TrainFilter()):
        row = _extendable(rows, call.prompt_ids)
        if row is None:
            row = TokenSequence()
            rows.append(row)
        row.extend_context(call.prompt_ids[len(row) :])
        row.extend_sampled(call, completion)
    return [row for row in rows if row.trained]


def trained_completions(trajectory: Trajectory, train: TrainFilter) -> list[tuple[LLMCall, Completion]]:
    """The completions of an episode that are trained, each with its call, in the order they were made."""
    roles = trajectory.spec.get("roles", {})
    own = [call for call in trajectory.calls if not matches(call.tag.path, roles)]
    return [(call, c) for call in own if call.tag.step < len(trajectory.transitions) for c in train.completions(call)]


def _extendable(rows: list[TokenSequence], prompt: SequenceOf[int]) -> TokenSequence | None:
    """The longest row that `prompt` begins with."""
    prompt = list(prompt)
    fitting = [r for r in rows if len(r) <= len(prompt) and prompt[: len(r)] == r.tokens]
    return max(fitting, key=len, default=None)
