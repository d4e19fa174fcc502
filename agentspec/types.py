"""The typed objects that cross module boundaries.

One step of an agent turns an observation into an :class:`AgentInput`, what memory recalls into a :class:`Recall`,
what reasoning chose into a :class:`Decision` and what the environment did into a :class:`Transition`. Every model call
on the way is one :class:`LLMCall`. An episode is a :class:`~agentspec.trajectory.Trajectory` of these. All are frozen:
a module that wants another value makes one with :func:`dataclasses.replace`.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from agentspec.tokens import clip_text, estimate_tokens, excerpt

Credit = Literal["executed", "explored", "aux"]
"""What a sampled completion did: chose the executed action, was explored and not taken, or helped (memory, critics)."""


@dataclass(frozen=True)
class Task:
    """One episode to run: the same task always starts the same episode.

    Args:
        env: registered environment id, e.g. ``"agentspec/DeliveryBench-v0"``.
        seed: seed given to ``env.reset``.
        options: keyword arguments of ``gymnasium.make`` (JSON values only).
        split: ``"train"``, ``"validation"`` or ``"test"``.
    """

    env: str
    seed: int = 0
    options: Mapping[str, Any] = field(default_factory=dict)
    split: str = "train"

    @property
    def key(self) -> str:
        """A short stable name of the task: 12 hex digits over all of its fields."""
        text = json.dumps(asdict(self), sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


@dataclass(frozen=True)
class Parameter:
    """One argument of an action: its type name, whether it must be given, and the allowed values if they are few.

    Args:
        default: what leaving it out means (`None`: nothing in particular).
        resolution: smallest difference that matters to the environment, in the schema's base unit (0: all do).
    """

    type: Literal["int", "float", "str", "list", "any"] = "any"
    required: bool = True
    enum: tuple[str, ...] = ()
    default: Any = None
    resolution: float = 0.0


@dataclass(frozen=True)
class ActionSpec:
    """One action an environment understands: name, what it does, and its parameters in positional order."""

    name: str
    description: str = ""
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    example: str = ""


@dataclass(frozen=True)
class ActionSchema:
    """All actions of an environment, and how their text reads.

    Args:
        actions: the actions by canonical (upper-case) name.
        aliases: other upper-case spellings -> canonical name.
        units: suffix -> factor; ``{"m": 100.0}`` reads ``12m`` as 1200.0 (see :mod:`agentspec.actions`).
        choices: if not empty, the answer must be one of these texts (menu mode); decoding is constrained to them.
    """

    actions: Mapping[str, ActionSpec]
    aliases: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, float] = field(default_factory=dict)
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class AgentInput:
    """u_t of the paper: instruction (static), state (JSON-like), text (dynamic summary), action schema, images.

    ``instruction`` is the same at every step of a task, so that prompts share the longest possible prefix; everything
    that changes stands in ``text``. ``images`` are ``uint8`` arrays of shape (H, W, 3).
    """

    instruction: str
    text: str
    action_schema: ActionSchema
    state: Mapping[str, Any] = field(default_factory=dict)
    images: tuple[Any, ...] = ()


@dataclass(frozen=True)
class RecallItem:
    """One thing remembered: text, relevance score, kind, where it came from, and how much it matters.

    Args:
        text: as it is shown.
        score: relevance, on the method's own scale; for the record only.
        kind: `episodic`, `summary`, `lesson`, ... Lessons are shown apart, within a budget of their own. A `step` (or a
            `failure`) does nothing but tell one of the newest steps, in their order: it is left out where the prompt
            tells these anyway.
        source: module or entry it came from.
        priority: what to keep when not everything fits: the lowest goes first; of equals, what is listed last.
    """

    text: str
    score: float = 0.0
    kind: str = "episodic"
    source: str = ""
    priority: float = 0.0


@dataclass(frozen=True)
class Recall:
    """m_t of the paper: what memory (or reflection) contributes to this step, in the order it is shown."""

    items: tuple[RecallItem, ...] = ()

    @property
    def lessons(self) -> Recall:
        """The items of kind `lesson`."""
        return Recall(tuple(i for i in self.items if i.kind == "lesson"))

    @property
    def memories(self) -> Recall:
        """All other items."""
        return Recall(tuple(i for i in self.items if i.kind != "lesson"))

    def render(self, budget: int, count_tokens: Callable[[str], int]) -> str:
        """The items, each on lines of its own, within `budget` tokens.

        What has the lowest priority is dropped first; the order shown stays; the last item that is not dropped is
        clipped, not lost. A line break counts one token.
        """
        kept: dict[int, str] = {}
        left = budget + 1  # no line break before the first
        for i in sorted(range(len(self.items)), key=lambda i: (-self.items[i].priority, i)):
            text = self.items[i].text
            cost = count_tokens(text) + 1
            if cost > left:
                text = clip_text(text, left - 1, count_tokens)
                if text and (not kept or left > MIN_CLIPPED):
                    kept[i] = text
                break
            kept[i] = text
            left -= cost
        return "\n".join(kept[i] for i in sorted(kept))


MIN_CLIPPED = 8
"""Tokens below which a clipped item says nothing and is left out, unless it is the only one."""


@dataclass(frozen=True)
class Action:
    """A parsed action: canonical name, positional and keyword arguments (units applied), and the text it came from.

    `plan` is what an answer in JSON said beside it about what comes next; it is no part of what is done.
    """

    name: str
    args: tuple[Any, ...] = ()
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    text: str = ""
    plan: str = field(default="", compare=False)


@dataclass(frozen=True)
class ActionError:
    """A text that is no action. ``message`` is written for the agent; ``code`` is for metrics and tests."""

    code: str
    message: str
    text: str = ""


@dataclass(frozen=True)
class CallTag:
    """Who asked: the module (``"reasoning.react"``), for what (``"act"``), in which episode, step and branch."""

    module: str
    purpose: str
    episode: str = ""
    step: int = -1
    branch: str = ""

    @property
    def path(self) -> str:
        """``module/purpose``: what ``train`` patterns and metrics match against."""
        return f"{self.module}/{self.purpose}"


@dataclass(frozen=True)
class Completion:
    """One sampled continuation, token by token.

    Args:
        text: decoded text, cut before a stop string.
        token_ids: every sampled token, end-of-turn included if it was sampled.
        logprobs: natural log-probability of each token under the *sampling* distribution (temperature, top-p and
            constraint applied); same length as ``token_ids``; empty if the backend does not report them.
        allowed: per token, the ids the constraint left to choose from, or ``None`` where it was free. Empty if no
            token was constrained. A token with one allowed id was forced: it has log-probability 0 and no gradient.
        finish_reason: ``"stop"``, ``"length"`` or ``"choice"``.
        credit: see :data:`Credit`.
    """

    text: str
    token_ids: tuple[int, ...] = ()
    logprobs: tuple[float, ...] = ()
    allowed: tuple[tuple[int, ...] | None, ...] = ()
    finish_reason: str = "stop"
    credit: Credit = "aux"


@dataclass(frozen=True)
class Usage:
    """Tokens in and out of one call, how many input tokens came from a cache, and dollars from the price table."""

    input_tokens: int = 0
    output_tokens: int = 0
    cached_tokens: int = 0
    cost: float = 0.0


@dataclass(frozen=True)
class Sampling:
    """How to sample. ``choices`` constrains the whole completion to one of the given texts.

    ``temperature`` 0 is greedy. ``top_p`` 1 and ``top_k`` 0 are off. ``stop`` strings end a completion and are cut
    from its text (their tokens stay in ``token_ids``). ``reasoning_tokens`` is room for hidden reasoning on top of
    ``max_tokens``, for models that think before they answer: a free answer may have both together. Answers bound to
    ``choices`` hold no reasoning.
    """

    temperature: float = 1.0
    top_p: float = 1.0
    top_k: int = 0
    max_tokens: int = 1024
    stop: tuple[str, ...] = ()
    n: int = 1
    choices: tuple[str, ...] = ()
    reasoning_tokens: int = 0

    def with_room(self) -> Sampling:
        """The same with the room for reasoning made part of ``max_tokens``: what a backend is asked for."""
        if not self.reasoning_tokens:
            return self
        room = self.max_tokens + (0 if self.choices else self.reasoning_tokens)
        return replace(self, max_tokens=room, reasoning_tokens=0)

    def __post_init__(self) -> None:
        bad = not 0 <= self.temperature < math.inf or not 0 < self.top_p <= 1  # NaN too
        bad |= self.top_k < 0 or self.max_tokens < 1 or self.n < 1
        if bad or self.reasoning_tokens < 0:
            raise ValueError(
                f"sampling parameters out of range: {self}; expected temperature >= 0, 0 < top_p <= 1, top_k >= 0, "
                "max_tokens >= 1, n >= 1, reasoning_tokens >= 0"
            )


@dataclass(frozen=True)
class Sampled:
    """A piece of an assistant turn that a model sampled: its text, and its token ids (empty if unknown).

    Prompts carry it verbatim: a backend that works on tokens never encodes it again.
    """

    text: str
    token_ids: tuple[int, ...] = ()

    @classmethod
    def of(cls, completion: Completion) -> Sampled:
        """The part that carries ``completion`` into a later prompt."""
        return cls(completion.text, completion.token_ids)


Part = str | Sampled
"""A piece of a chat turn: literal text, or what a model sampled."""


@dataclass(frozen=True)
class Picture:
    """A picture in a user turn: PNG bytes, and its size in pixels."""

    png: bytes = field(repr=False)
    width: int
    height: int


@dataclass(frozen=True)
class LLMCall:
    """Every model call an episode makes: the one record that cost accounting and RL training both read."""

    id: int
    tag: CallTag
    prompt_ids: tuple[int, ...]
    completions: tuple[Completion, ...]
    sampling: Sampling
    usage: Usage = Usage()
    latency_s: float = 0.0
    model: str = ""

    @property
    def text(self) -> str:
        """Text of the first completion."""
        return self.completions[0].text


@dataclass(frozen=True)
class Decision:
    """r_t of the paper: the action chosen, why, what else was considered, and which completions produced it.

    ``calls`` holds (call id, completion index) pairs; the agent credits these as ``executed``. ``valid`` is False when
    the model's answer was no action (``action`` is then the :class:`ActionError`) or a fallback was used. ``turn`` is
    the assistant turn that an append-only context keeps of this step (empty: the action's text).
    """

    action: Action | ActionError
    rationale: str = ""
    candidates: tuple[tuple[str, float], ...] = ()
    calls: tuple[tuple[int, int], ...] = ()
    valid: bool = True
    turn: tuple[Part, ...] = ()
    trace: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Transition:
    """One step: what the agent saw, decided and got. ``info`` is the environment's JSON-like report of the step."""

    step: int
    input: AgentInput
    decision: Decision
    action_text: str
    reward: float
    next_text: str
    terminated: bool = False
    truncated: bool = False
    info: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Experience:
    """What a memory usually keeps of a step: the state it was taken in, the action, and what came of it.

    Args:
        step: number of the step, from 0.
        state: the observation the action was chosen for.
        action: the action as it was executed.
        ok: whether the environment could carry it out.
        feedback: what the environment said about it; the error if it was not possible.
        reward: reward of the step.
    """

    step: int
    state: str
    action: str
    ok: bool
    feedback: str
    reward: float

    @classmethod
    def of(cls, transition: Transition) -> Experience:
        """The experience of a transition."""
        info = transition.info
        error = str(info.get("error") or "")
        ok = not error and not info.get("invalid") and isinstance(transition.decision.action, Action)
        action = transition.decision.action
        why = action.message if isinstance(action, ActionError) else ""
        feedback = error or str(info.get("message") or why or ("done" if ok else "failed"))
        return cls(transition.step, transition.input.text, transition.action_text, ok, feedback, transition.reward)

    def line(self) -> str:
        """One line: number (from 1), action, what it did, and the reward if there was one."""
        reward = f" ({self.reward:+.2f})" if self.reward else ""
        return f"{self.step + 1}. {self.action} -> {self.feedback}{reward}"

    def block(self, tokens: int, count_tokens: Callable[[str], int] = estimate_tokens) -> str:
        """State, action, result and reward on labelled lines, within `tokens`: what is too long is the state.

        Only if there is no room for the rest either is the rest clipped.
        """
        reward = f"\nReward: {self.reward:+.2f}" if self.reward else ""
        rest = f"Action: {self.action}\nResult: {self.feedback}{reward}"
        room = tokens - count_tokens(rest) - count_tokens("State: \n")
        state = excerpt(self.state, room, count_tokens) if room > 0 else ""
        return f"State: {state}\n{rest}" if state else clip_text(rest, tokens, count_tokens)
