"""`agentspec view`: a recorded episode, readable."""

from __future__ import annotations

import argparse
import textwrap
from itertools import islice
from pathlib import Path
from typing import Any

from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory, read_trajectories
from agentspec.types import Transition

WIDTH = 116


def add_parser(commands: Any) -> None:
    """Arguments of `agentspec view`."""
    parser = commands.add_parser("view", help="print a recorded episode", description="Print a recorded episode.")
    parser.add_argument("file", metavar="TRAJ.jsonl", help="trajectories, one JSON line each")
    parser.add_argument("--episode", type=int, default=0, metavar="N", help="which of them, from 0")
    parser.add_argument("--steps", default="", metavar="A-B", help="only these steps")
    parser.add_argument("--full", action="store_true", help="observations and every model call as well")
    parser.set_defaults(command=run)


def run(arguments: argparse.Namespace) -> int:
    """Print one episode."""
    trajectory = _nth(Path(arguments.file), arguments.episode)
    wanted = _range(arguments.steps)
    print("\n".join(header(trajectory)))
    for transition in trajectory.transitions:
        if transition.step in wanted:
            print("\n".join(step_lines(trajectory, transition, full=arguments.full)))
    print("\n".join(footer(trajectory)))
    return 0


def header(trajectory: Trajectory) -> list[str]:
    """Task, agent and instruction."""
    task = trajectory.task
    modules = ", ".join(f"{k}={_name(v)}" for k, v in trajectory.spec.items() if k in _MODULES)
    lines = [f"{task.env} seed {task.seed} {dict(task.options) or ''}".rstrip(), f"agent: {modules}"]
    if trajectory.policy:
        lines.append(f"policy: {trajectory.policy}")
    if trajectory.transitions:
        lines += ["", *_wrap(trajectory.transitions[0].input.instruction)]
    return lines


def step_lines(trajectory: Trajectory, transition: Transition, *, full: bool = False) -> list[str]:
    """One step: thought, action, result, reward."""
    lines = ["", f"--- step {transition.step} " + "-" * 20]
    if full:
        lines += _wrap(transition.input.text)
        for call in trajectory.calls:
            if call.tag.step == transition.step:
                usage = f"{call.usage.input_tokens}+{call.usage.output_tokens} tokens, {call.latency_s:.2f} s"
                lines += [f"[{call.tag.path}, {usage}]", *_wrap(call.text, "    ")]
    elif transition.decision.rationale:
        lines += _wrap(f"thought: {transition.decision.rationale}")
    flag = "" if transition.decision.valid else "  (invalid)"
    lines.append(f"action: {transition.action_text}{flag}")
    result = transition.info.get("error") or transition.info.get("message")
    if result:
        lines += _wrap(f"result: {result}")
    if transition.reward:
        lines.append(f"reward: {transition.reward:+.2f}")
    return lines


def footer(trajectory: Trajectory) -> list[str]:
    """How it ended, and the figures that are plain numbers."""
    lines = ["", f"{trajectory.status}{': ' + trajectory.error if trajectory.error else ''}"]
    for name, value in trajectory.metrics.items():
        if isinstance(value, (bool, int, str)):
            lines.append(f"  {name}: {value}")
        elif isinstance(value, float):
            lines.append(f"  {name}: {value:.4g}")
    return lines


_MODULES = ("perception", "memory", "reasoning", "reflection", "layout")


def _name(value: Any) -> str:
    return str(value["name"]) if isinstance(value, dict) else str(value)


def _wrap(text: str, indent: str = "") -> list[str]:
    """Lines no longer than the screen; the text's own line breaks stay."""
    return [
        piece
        for line in text.splitlines()
        for piece in textwrap.wrap(line, WIDTH, initial_indent=indent, subsequent_indent=indent + "  ") or [""]
    ]


def _nth(path: Path, number: int) -> Trajectory:
    found = next(islice(read_trajectories(path), max(0, number), None), None)
    if found is None or number < 0:
        count = sum(1 for _ in read_trajectories(path))
        raise SpecError(f"{path} holds {count} episodes, numbered from 0; there is no episode {number}")
    return found


def _range(text: str) -> range:
    if not text:
        return range(1 << 31)
    first, dash, last = text.partition("-")
    if not first.isdigit() or (last and not last.isdigit()):
        raise SpecError(f"--steps {text!r}: expected A-B, A- or A")
    return range(int(first), int(last) + 1 if last else 1 << 31 if dash else int(first) + 1)
