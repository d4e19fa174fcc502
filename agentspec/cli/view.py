"""`agentspec view`: a recorded episode, or what a carried memory holds, readable."""

from __future__ import annotations

import argparse
import json
import textwrap
from itertools import islice
from pathlib import Path
from typing import Any

from agentspec.carry import KIND, read_bank
from agentspec.cli.arguments import at_least
from agentspec.cli.logs import holds_logs, view_logs
from agentspec.files import write_atomic
from agentspec.memory_text import data, diff, text
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory, read_trajectories
from agentspec.types import Transition

WIDTH = 116


def add_parser(commands: Any) -> None:
    """Arguments of `agentspec view`."""
    parser = commands.add_parser(
        "view",
        help="print a recorded episode, or a memory",
        description="Print a recorded episode, or (--memory) what a memory file holds.",
    )
    parser.add_argument("file", metavar="TRAJ.jsonl|DIR", nargs="?", help="trajectories, or a folder of Inspect logs")
    parser.add_argument("--bundle", metavar="DIR", default="", help="with a folder of logs: write a static site there")
    parser.add_argument("--episode", type=at_least(0), default=0, metavar="N", help="which of them, from 0")
    parser.add_argument("--steps", default="", metavar="A-B", help="only these steps")
    parser.add_argument("--full", action="store_true", help="observations and every model call as well")
    parser.add_argument("--memory", metavar="FILE", help="a memory file, or a run folder that holds one")
    parser.add_argument("--diff", metavar="FILE", help="with --memory: what another one holds in its place")
    parser.add_argument("--task", default="", metavar="KEY", help="with --memory: only this task")
    parser.add_argument("--json", action="store_true", help="with --memory: the states as JSON")
    parser.add_argument("--to", metavar="FILE", help="with --memory: write there instead of printing")
    parser.set_defaults(command=run)


def run(arguments: argparse.Namespace) -> int:
    """Print one episode, or a memory."""
    if arguments.memory is not None:
        return _memory(arguments)
    if arguments.file is None:
        raise SpecError("give a file of trajectories, or --memory with a memory file")
    given = [n for n in ("diff", "task", "json", "to") if getattr(arguments, n)]
    if given:
        raise SpecError(f"--{given[0]} goes with --memory")
    if holds_logs(arguments.file):
        return view_logs(arguments.file, arguments.bundle)
    trajectory = _nth(Path(arguments.file), arguments.episode)
    wanted = _range(arguments.steps)
    print("\n".join(header(trajectory)))
    for transition in trajectory.transitions:
        if transition.step in wanted:
            print("\n".join(step_lines(trajectory, transition, full=arguments.full)))
    print("\n".join(footer(trajectory)))
    return 0


def _memory(arguments: argparse.Namespace) -> int:
    """A memory file as text or JSON, or the difference of two."""
    if arguments.file is not None:
        raise SpecError(f"give trajectories ({arguments.file}) or --memory, not both")
    if arguments.diff and arguments.json:
        raise SpecError("--diff prints text; leave out --json")
    bank = read_bank(arguments.memory)
    if arguments.json:
        shown = json.dumps(data(bank, arguments.task), indent=2, ensure_ascii=False)
    elif arguments.diff:
        shown = "\n".join(diff(bank, read_bank(arguments.diff), arguments.task))
    else:
        shown = "\n".join(text(bank, arguments.task))
    if arguments.to:
        write_atomic(Path(arguments.to), shown + "\n")
        print(f"{arguments.memory} -> {arguments.to}")
    else:
        print(shown)
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
    _check_kind(path)
    found = next(islice(read_trajectories(path), number, None), None)
    if found is None:
        count = sum(1 for _ in read_trajectories(path))
        raise SpecError(f"{path} holds {count} episodes, numbered from 0; there is no episode {number}")
    return found


def _check_kind(path: Path) -> None:
    """Refuse a file that holds no trajectories.

    Raises:
        SpecError: naming what it seems to be, and what this command reads.
    """
    line = b""
    if not path.is_dir():
        with open(path, "rb") as file:
            line = file.readline(1 << 26)
    try:
        data = json.loads(line)
        if isinstance(data, dict) and {"task", "steps"} <= data.keys():
            return
        memory = isinstance(data, dict) and data.get("kind") == KIND
    except ValueError:
        memory = False
    hint = f"; it is a memory file: agentspec view --memory {path}" if memory else ""
    raise SpecError(
        f"{path} holds no trajectories{hint}; `view` reads the .jsonl that `agentspec run --out` and the folder "
        "`trajectories/` of a run hold, and with --memory the memory file of a run"
    )


def _range(text: str) -> range:
    if not text:
        return range(1 << 31)
    first, dash, last = text.partition("-")
    if not first.isdigit() or (last and not last.isdigit()):
        raise SpecError(f"--steps {text!r}: expected A-B, A- or A")
    return range(int(first), int(last) + 1 if last else 1 << 31 if dash else int(first) + 1)
