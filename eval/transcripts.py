"""An episode as plain text, for a reader who labels it: what was asked, seen, done, and answered.

Nothing of the agent's insides (modules, thoughts, token scores) and nothing of what any rule found.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

from agentspec.metrics import declared
from agentspec.tokens import CountTokens
from agentspec.trajectory import Trajectory
from agentspec.types import ActionError, Transition

WHOLE = 700
"""Characters up to which an observation is shown whole; of longer ones, only the lines that are new since the last."""
LINE, ANSWER, OUTCOME = 420, 300, 200
"""Most characters of a line, of what the agent wrote, and of what the world answered."""
SURROUNDINGS = ("- nearest:", "- ways from here:", "- junctions:", "Around you:", "Last action:", "Last error:")
"""Beginnings of lines that the readers of our samples were shown at an episode's first step only."""
GAP = 12
"""Tokens kept for each mark of what an excerpt leaves out."""


@dataclass(frozen=True)
class _Step:
    """Lines of one step: its number, what was seen, what was done and answered; and whether that was refused."""

    title: str
    seen: list[str]
    done: list[str]
    refused: bool

    @property
    def lines(self) -> list[str]:
        return [self.title, *self.seen, *self.done]


@dataclass(frozen=True)
class _Parts:
    task: list[str]
    steps: list[_Step]
    afterwards: list[str]
    end: str


def transcript(trajectory: Trajectory, *, known: Collection[str] = (), left_out: Sequence[str] = ()) -> str:
    """The episode in lines; long observations shortened to what changed.

    Args:
        known: lines of the instruction that stand elsewhere.
        left_out: beginnings of lines of observations that are shown at the first step only.

    >>> from agentspec.types import Task
    >>> print(transcript(Trajectory(Task("toy"), {}, metrics={"success": 0.0})))
    WORLD: toy
    <BLANKLINE>
    TASK
    <BLANKLINE>
    END: played to its end; success 0.
    """
    return _joined(_parts(trajectory, known, left_out))


def excerpt(trajectory: Trajectory, room: int, count: CountTokens, *, left_out: Sequence[str] = ()) -> str:
    """The transcript in about `room` tokens: whole where it fits, else cut in its middle.

    What is kept, in this order: the task and the end (long ones cut in their own middle), what was done and answered at
    every step that was refused, then the steps from both ends inwards, with what was seen as long as there is room.
    """
    parts = _parts(trajectory, (), left_out)
    if count(text := _joined(parts)) <= room:
        return text
    task, afterwards = (_cut_lines(p, room // n, count) for p, n in ((parts.task, 3), (parts.afterwards, 6)))
    left = room - _size([*task, *afterwards, parts.end], count) - GAP
    shown: dict[int, list[str]] = {}
    refused = [i for i in _inwards(len(parts.steps)) if parts.steps[i].refused]
    for whole, i in [*((False, i) for i in refused), *((True, i) for i in _inwards(len(parts.steps)))]:
        step, before = parts.steps[i], _size(shown[i], count) if i in shown else -GAP
        brief = [step.title, *step.done]
        full = [step.title, *_cut_lines(step.seen, room // 4, count), *step.done]
        for lines in (full, brief) if whole else (brief,):
            if (more := _size(lines, count) - before) <= left and lines != shown.get(i):
                shown[i], left = lines, left - more
                break
    return "\n".join([*task, *_with_gaps(shown, len(parts.steps)), *afterwards, parts.end])


def _parts(trajectory: Trajectory, known: Collection[str], left_out: Sequence[str]) -> _Parts:
    steps = trajectory.transitions
    asked = [line for line in (steps[0].input.instruction if steps else "").splitlines() if line not in known]
    found, before = [], ""
    for t in steps:
        done = [f"  DOES: {_flat(_written(t), ANSWER)}", f"  ANSWER: {_flat(_outcome(t), OUTCOME) or '(none)'}"]
        refused = bool(t.info.get("invalid") or t.info.get("error")) or not t.decision.valid
        found.append(_Step(f"STEP {t.step}", _seen(t.input.text, before, left_out), done, refused))
        before = t.input.text
    afterwards = ["AFTERWARDS", *_seen(steps[-1].next_text, before, left_out)] if steps else []
    return _Parts([f"WORLD: {trajectory.task.env}", "", "TASK", *asked, ""], found, afterwards, _end(trajectory))


def _joined(parts: _Parts) -> str:
    lines = (line for step in parts.steps for line in step.lines)
    return "\n".join([*parts.task, *lines, *parts.afterwards, parts.end])


def _size(lines: Sequence[str], count: CountTokens) -> int:
    return count("\n".join(lines) + "\n")


def _inwards(number: int) -> Iterator[int]:
    """0, the last, 1, the last but one, ..."""
    return (i // 2 if i % 2 == 0 else number - 1 - i // 2 for i in range(number))


def _cut_lines(lines: list[str], room: int, count: CountTokens) -> list[str]:
    """Lines from both ends as long as they fit, and a mark between them."""
    if _size(lines, count) <= room:
        return lines
    kept: set[int] = set()
    left = room - GAP
    for i in _inwards(len(lines)):
        if (cost := _size(lines[i : i + 1], count)) > left:
            break
        kept.add(i)
        left -= cost
    front = [lines[i] for i in range(len(lines)) if i in kept and all(j in kept for j in range(i))]
    back = [lines[i] for i in sorted(kept) if i >= len(front)]
    return [*front, "[...]", *back]


def _with_gaps(shown: dict[int, list[str]], number: int) -> Iterator[str]:
    """The steps that are shown, and between them how many are not."""
    before = -1
    for i in [*sorted(shown), number]:
        if missing := i - before - 1:
            yield f"[{missing} step{'s' * (missing > 1)} left out]"
        yield from shown.get(i, ())
        before = i


def _seen(text: str, before: str, left_out: Sequence[str]) -> list[str]:
    """An observation, indented; of a long one that follows another, the lines that are new."""
    lines, known = text.splitlines(), set(before.splitlines())
    if before and len(text) > WHOLE:
        lines = [line for line in lines if line.strip() and line not in known and not line.startswith(tuple(left_out))]
    lines = lines or ["(as before)"]
    return [f"  SEES: {_cut(line, LINE)}" if i == 0 else f"        {_cut(line, LINE)}" for i, line in enumerate(lines)]


def _written(t: Transition) -> str:
    error = t.decision.action if isinstance(t.decision.action, ActionError) else None
    return error.text if error and error.text else t.action_text


def _outcome(t: Transition) -> str:
    message, error = str(t.info.get("message") or ""), str(t.info.get("error") or "")
    return message if error in message else f"failed: {error}"


def _end(trajectory: Trajectory) -> str:
    metrics, last = trajectory.metrics, trajectory.transitions[-1] if trajectory.transitions else None
    how = "the steps were used up" if last and last.truncated and not last.terminated else "played to its end"
    names = dict.fromkeys(["success", *(m.name for m in declared(trajectory.task.env))])
    figures = [f"{n.replace('_', ' ')} {float(metrics[n]):g}" for n in names if metrics.get(n) is not None]
    return f"END: {how}; {', '.join(figures) or 'no figures'}."


def _flat(text: str, most: int) -> str:
    return _cut(re.sub(r"\s+", " ", text).strip(), most)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[:most]}[...]"
