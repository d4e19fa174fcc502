"""An episode as plain text, for a reader who labels it: what was asked, seen, done, and answered.

Nothing of the agent's insides (modules, thoughts, token scores) and nothing of what any rule found.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

from agentspec.metrics import declared
from agentspec.trajectory import Trajectory
from agentspec.types import ActionError, Transition

WHOLE = 700
"""Characters up to which an observation is shown whole; of longer ones, only the lines that are new since the last."""
LINE, ANSWER, OUTCOME = 420, 300, 200
"""Most characters of a line, of what the agent wrote, and of what the world answered."""


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
    steps = trajectory.transitions
    asked = [line for line in (steps[0].input.instruction if steps else "").splitlines() if line not in known]
    lines = [f"WORLD: {trajectory.task.env}", "", "TASK", *asked, ""]
    before = ""
    for t in steps:
        lines += [f"STEP {t.step}", *_seen(t.input.text, before, left_out), f"  DOES: {_flat(_written(t), ANSWER)}"]
        lines.append(f"  ANSWER: {_flat(_outcome(t), OUTCOME) or '(none)'}")
        before = t.input.text
    if steps:
        lines += ["AFTERWARDS", *_seen(steps[-1].next_text, before, left_out)]
    return "\n".join([*lines, _end(trajectory)])


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
