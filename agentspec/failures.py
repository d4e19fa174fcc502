"""Why an episode went wrong: the twelve kinds of failure of the AgentSpec paper, read off a trajectory by rules.

A rule gives a `Sign` only where the record proves it: a text that is no action, an action that failed and was written
again, a battery that ran empty. What holds in every world stands here; what only a world can know stands in its folder
(`signs.py`), which its class names: `failure_signs = "package.module:function"`, called with the trajectory. A failure
without a sign is left open: a reader, or a model, has to judge it.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from agentspec.importing import import_name
from agentspec.types import ActionError, Transition

if TYPE_CHECKING:
    from agentspec.trajectory import Trajectory

LEAVES: dict[str, str] = {
    "parse/unstructured_memory": "memory runs into the answer: earlier texts are copied in place of an action",
    "parse/action_interface/hallucination": "an action that does not exist, or a text that is none",
    "parse/action_interface/parameter": "an action that exists with values that it does not take",
    "understanding/state_confusion/missing_history": "does again what failed long ago: it is not remembered",
    "understanding/state_confusion/history_misunderstood": "does again what just failed or is done",
    "understanding/knowledge/rule_unfamiliar": "breaks a rule of the world that the prompt states",
    "understanding/knowledge/numerical": "misjudges time, money, energy or battery",
    "understanding/knowledge/strategy": "obeys the rules and gets nowhere: a bad plan, or none",
    "grounding/object/misclassification": "takes one thing for another",
    "grounding/object/hallucination": "acts on what is not there",
    "grounding/spatial/stuck": "runs into obstacles or in circles",
    "grounding/spatial/distance": "acts too far away, or at the wrong place",
}
"""Kind of failure, as a path -> what it is. Names are those of the paper's figure, definitions are ours."""

RECENT = 8
"""Steps back that an agent can be expected to have in its prompt; beyond them a repetition is forgotten history."""
COPIED = 80
"""Characters of an earlier text in an answer that is no action, from which on it counts as copied."""

_PARAMETER = ("PARSE_ARGS", "ARGS", "RANGE", "missing_argument")


@dataclass(frozen=True)
class Sign:
    """A rule that found something.

    Args:
        leaf: kind of failure, a key of `LEAVES`.
        step: at which step of the episode.
        why: what proves it, in words.
    """

    leaf: str
    step: int
    why: str

    def __post_init__(self) -> None:
        if self.leaf not in LEAVES:
            raise ValueError(f"unknown kind of failure {self.leaf!r}; expected one of {', '.join(LEAVES)}")


def signs(trajectory: Trajectory) -> list[Sign]:
    """Everything the rules find, in the order of steps: those of any world, then those of this one."""
    from agentspec.envs.making import environment_class

    found = [*_unreadable(trajectory.transitions), *_repeated_errors(trajectory.transitions)]
    own = getattr(environment_class(trajectory.task.env), "failure_signs", "")
    if own:
        found += import_name(own)(trajectory)
    return sorted(found, key=lambda sign: sign.step)


def is_failure(trajectory: Trajectory) -> bool | None:
    """Whether an episode is a failure: its task not achieved, or, where tasks are graded, nothing earned.

    `None` for an episode that could not be played to its end.
    """
    if not trajectory.scorable:
        return None
    success = trajectory.metrics.get("success")
    if success is not None:
        return not success
    return float(trajectory.metrics.get("return") or 0.0) <= 0


def leading(found: Sequence[Sign]) -> str:
    """The kind with signs at the most steps (of equals the one seen first); empty without signs."""
    steps = Counter(leaf for leaf, _ in dict.fromkeys((sign.leaf, sign.step) for sign in found))
    return max(steps, key=steps.__getitem__) if steps else ""


def _unreadable(transitions: Sequence[Transition]) -> Iterator[Sign]:
    """Steps whose text was no action."""
    earlier: list[str] = []
    for t in transitions:
        error = t.decision.action if isinstance(t.decision.action, ActionError) else None
        code = error.code if error else str(t.info.get("error_code") or "")
        text = error.text if error and error.text else t.action_text
        if error or code.startswith("PARSE") or code in _PARAMETER:
            if _copies(text, [t.input.text, *earlier]):
                yield Sign("parse/unstructured_memory", t.step, "the answer copies what was shown before")
            elif code in _PARAMETER:
                yield Sign("parse/action_interface/parameter", t.step, _reason(t, error))
            elif code != "BUDGET":
                yield Sign("parse/action_interface/hallucination", t.step, _reason(t, error))
        earlier = [*earlier, t.action_text, t.next_text][-2 * RECENT :]


def _reason(t: Transition, error: ActionError | None) -> str:
    return (error.message if error else str(t.info.get("error") or ""))[:200]


def _copies(text: str, earlier: Sequence[str]) -> bool:
    """Whether a run of it stands in an earlier text, however both are broken into lines."""
    text, *shown = (" ".join(one.split()) for one in (text, *earlier))
    if len(text) < COPIED:
        return False
    windows = (text[i : i + COPIED] for i in range(0, len(text) - COPIED + 1, COPIED // 4))
    return any(window in one for window in windows for one in shown)


def _repeated_errors(transitions: Sequence[Transition]) -> Iterator[Sign]:
    """The same action refused for the same reason again."""
    refused: dict[tuple[str, str], int] = {}
    for i, t in enumerate(transitions):
        if not t.info.get("invalid"):
            continue
        key = t.action_text, str(t.info.get("error"))
        before = refused.get(key)
        if before is not None:
            kind = "history_misunderstood" if i - before <= RECENT else "missing_history"
            why = f"{t.action_text} failed {i - before} steps ago for the same reason: {key[1]}"
            yield Sign(f"understanding/state_confusion/{kind}", t.step, why[:200])
        refused[key] = i


def in_vain_again(transitions: Sequence[Transition], in_vain: Callable[[Transition], bool]) -> Iterator[Sign]:
    """Steps at which what came to nothing just before is done again, for worlds that do not call it an error."""
    for before, t in itertools.pairwise(transitions):
        if t.action_text == before.action_text and in_vain(before) and in_vain(t):
            why = f"{t.action_text} came to nothing just before"
            yield Sign("understanding/state_confusion/history_misunderstood", t.step, why[:200])


def revisits(keys: Sequence[object], times: int = 3) -> Iterator[int]:
    """Positions of a sequence at which something stands for at least the `times`-th time.

    >>> list(revisits(["a", "b", "a", "a", "a"]))
    [3, 4]
    """
    seen: Counter[object] = Counter()
    for i, key in enumerate(keys):
        seen[key] += 1
        if seen[key] >= times:
            yield i


def in_a_row(hits: Sequence[bool], least: int = 2) -> Iterator[int]:
    """Positions from the `least`-th of consecutive hits on.

    >>> list(in_a_row([True, True, True, False, True]))
    [1, 2]
    """
    run = 0
    for i, hit in enumerate(hits):
        run = run + 1 if hit else 0
        if run >= least:
            yield i
