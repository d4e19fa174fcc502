"""The record of one episode: one JSON line, written atomically, read back, replayed.

A trajectory holds everything that evaluation, rewards and training need: the task, the spec, every transition, every
model call with its tokens and log-probabilities, the environment's metrics, seed and versions. Prompts of successive
calls mostly extend each other, so a prompt is stored as what it keeps of the tokens before it, and the rest.
`docs/trajectories.md` describes every field of the format and has a reader that stands alone.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from agentspec import __version__
from agentspec.files import jsonable, write_atomic
from agentspec.tokens import shared_prefix
from agentspec.types import (
    Action,
    ActionError,
    ActionSchema,
    AgentInput,
    CallTag,
    Completion,
    Decision,
    LLMCall,
    Sampled,
    Sampling,
    Task,
    Transition,
    Usage,
)

FORMAT = 2
READABLE = (1, 2)
"""Formats that are read; format 1 wrote a prompt as `prompt_ids: [kept, *new]`."""


@dataclass(frozen=True)
class Trajectory:
    """One finished episode.

    ``status`` is ``"completed"`` (ended or truncated by the environment, the budget or the context) or ``"failed"``
    (environment crash, hang, NaN reward, model error): a failed episode has no return and takes part in no baseline.
    ``metrics`` are the environment's figures plus the scaffold's (steps, tokens, thinking time, cost).
    """

    task: Task
    spec: Mapping[str, Any]
    rollout: int = 0
    seed: int = 0
    policy: str = ""
    transitions: tuple[Transition, ...] = ()
    calls: tuple[LLMCall, ...] = ()
    metrics: Mapping[str, Any] = field(default_factory=dict)
    status: str = "completed"
    error: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    memory_state: bytes | None = field(default=None, compare=False)

    @property
    def episode(self) -> str:
        """Id of the episode: task, rollout and seed."""
        return f"{self.task.key}-{self.rollout}-{self.seed:x}"

    @property
    def scorable(self) -> bool:
        """Whether the episode has a return."""
        return self.status == "completed"

    def to_json(self) -> str:
        """One line of JSON without its newline; the same trajectory gives the same bytes."""
        first = self.transitions[0].input if self.transitions else None
        data = {
            "format": FORMAT,
            "task": asdict(self.task),
            "spec": self.spec,
            "rollout": self.rollout,
            "seed": self.seed,
            "policy": self.policy,
            "status": self.status,
            "error": self.error,
            "versions": self.versions,
            "metrics": self.metrics,
            "instruction": first.instruction if first else "",
            "steps": [_step_to_json(t) for t in self.transitions],
            "calls": _calls_to_json(self.calls),
        }
        return json.dumps(data, sort_keys=True, separators=(",", ":"), ensure_ascii=False, default=str)

    @classmethod
    def from_json(cls, line: str) -> Trajectory:
        """Read what `to_json` wrote.

        Raises:
            ValueError: not a trajectory, or of a format this version does not read.
        """
        return cls.from_data(json.loads(line))

    @classmethod
    def from_data(cls, data: Any) -> Trajectory:
        """The trajectory of a line that was parsed already.

        Raises:
            ValueError: as `from_json`.
        """
        if not isinstance(data, dict) or data.get("format") not in READABLE:
            found = data.get("format") if isinstance(data, dict) else type(data).__name__
            raise ValueError(f"not a trajectory of format {FORMAT} (found {found}); record it again with this version")
        return cls(
            task=Task(**data["task"]),
            spec=data["spec"],
            rollout=data["rollout"],
            seed=data["seed"],
            policy=data["policy"],
            transitions=tuple(_step_from_json(s, data["instruction"]) for s in data["steps"]),
            calls=_calls_from_json(data["calls"]),
            metrics=data["metrics"],
            status=data["status"],
            error=data["error"],
            versions=data["versions"],
        )


def versions() -> dict[str, str]:
    """Versions of the packages that decide what an episode is."""
    return dict(_versions())


@functools.cache
def _versions() -> dict[str, str]:
    found = {"agentspec": __version__}
    for name in ("gymnasium", "minigrid", "numpy", "peft", "torch", "transformers"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def write_trajectories(path: str | Path, trajectories: Iterable[Trajectory]) -> None:
    """Write JSONL, whole or not at all."""
    write_atomic(path, "".join(t.to_json() + "\n" for t in trajectories))


def read_trajectories(path: str | Path) -> Iterator[Trajectory]:
    """Read JSONL, one trajectory at a time.

    Raises:
        ValueError: naming file and line of what is not a trajectory.
    """
    with open(path, encoding="utf-8") as file:
        for number, line in enumerate(file, 1):
            if line.strip():
                try:
                    yield Trajectory.from_json(line)
                except (ValueError, KeyError, TypeError) as error:
                    raise ValueError(f"{path}, line {number}: {error}") from error


def replay(trajectory: Trajectory, make_env: Callable[[Task], Any]) -> list[str]:
    """Play the recorded actions again and list every difference (empty: the episode is reproduced exactly).

    Compares each observation text, reward and end, and the environment's final metrics.
    """
    env = make_env(trajectory.task)
    differences: list[str] = []

    def compare(what: str, expected: Any, got: Any) -> None:
        if expected != got:
            differences.append(f"{what}: recorded {expected!r}, replayed {got!r}")

    try:
        observation, info = env.reset(seed=trajectory.task.seed)
        for t in trajectory.transitions:
            compare(f"step {t.step} observation", t.input.text, observation["text"])
            deliberate = getattr(getattr(env, "unwrapped", env), "deliberate", None)
            if callable(deliberate) and "thought" in t.info:
                deliberate(*t.info["thought"])
            observation, reward, terminated, _, info = env.step(t.action_text)
            if not math.isclose(t.reward, float(reward), rel_tol=0, abs_tol=1e-12):
                compare(f"step {t.step} reward", t.reward, float(reward))
            compare(f"step {t.step} terminated", t.terminated, bool(terminated))
        for name, value in jsonable(info.get("metrics", {})).items():
            compare(f"metric {name}", trajectory.metrics.get(name), value)
    finally:
        env.close()
    return differences


def _step_to_json(t: Transition) -> dict[str, Any]:
    decision = t.decision
    error = decision.action if isinstance(decision.action, ActionError) else None
    return {
        "step": t.step,
        "text": t.input.text,
        "choices": list(t.input.action_schema.choices),
        "state": jsonable(t.input.state),
        "action": t.action_text,
        "error": None if error is None else [error.code, error.message],
        "valid": decision.valid,
        "rationale": decision.rationale,
        "candidates": [list(c) for c in decision.candidates],
        "decision_calls": [list(c) for c in decision.calls],
        "turn": [p if isinstance(p, str) else asdict(p) for p in decision.turn],
        "trace": jsonable(decision.trace),
        "reward": t.reward,
        "next_text": t.next_text,
        "terminated": t.terminated,
        "truncated": t.truncated,
        "info": jsonable(t.info),
    }


def _step_from_json(data: Mapping[str, Any], instruction: str) -> Transition:
    action: Action | ActionError
    if data["error"] is None:
        action = Action(data["action"].partition("(")[0].strip().upper() or data["action"], text=data["action"])
    else:
        action = ActionError(data["error"][0], data["error"][1], data["action"])
    decision = Decision(
        action=action,
        rationale=data["rationale"],
        candidates=tuple((c[0], c[1]) for c in data["candidates"]),
        calls=tuple((c[0], c[1]) for c in data["decision_calls"]),
        valid=data["valid"],
        turn=tuple(p if isinstance(p, str) else Sampled(p["text"], tuple(p["token_ids"])) for p in data["turn"]),
        trace=data["trace"],
    )
    schema = ActionSchema({}, choices=tuple(data["choices"]))
    return Transition(
        step=data["step"],
        input=AgentInput(instruction, data["text"], schema, data["state"]),
        decision=decision,
        action_text=data["action"],
        reward=data["reward"],
        next_text=data["next_text"],
        terminated=data["terminated"],
        truncated=data["truncated"],
        info=data["info"],
    )


def _calls_to_json(calls: Sequence[LLMCall]) -> list[dict[str, Any]]:
    rows = []
    before: tuple[int, ...] = ()
    for call in calls:
        shared = shared_prefix(before, call.prompt_ids)
        row = asdict(call)
        del row["prompt_ids"]
        row["prompt"] = {"kept": shared, "new": list(call.prompt_ids[shared:])}
        rows.append(row)
        before = call.prompt_ids + (call.completions[0].token_ids if call.completions else ())
    return rows


def _calls_from_json(rows: Sequence[Mapping[str, Any]]) -> tuple[LLMCall, ...]:
    calls: list[LLMCall] = []
    before: tuple[int, ...] = ()
    for row in rows:
        kept, new = _prompt_of(row)
        if not 0 <= kept <= len(before):
            raise ValueError(f"call {row['id']} keeps {kept} tokens of the {len(before)} before it")
        completions = tuple(
            Completion(
                text=c["text"],
                token_ids=tuple(c["token_ids"]),
                logprobs=tuple(c["logprobs"]),
                allowed=tuple(None if a is None else tuple(a) for a in c["allowed"]),
                finish_reason=c["finish_reason"],
                credit=c["credit"],
            )
            for c in row["completions"]
        )
        sampling: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in row["sampling"].items()}
        call = LLMCall(
            id=row["id"],
            tag=CallTag(**row["tag"]),
            prompt_ids=before[:kept] + tuple(new),
            completions=completions,
            sampling=Sampling(**sampling),
            usage=Usage(**row["usage"]),
            latency_s=row["latency_s"],
            model=row["model"],
        )
        calls.append(call)
        before = call.prompt_ids + (call.completions[0].token_ids if call.completions else ())
    return tuple(calls)


def _prompt_of(row: Mapping[str, Any]) -> tuple[int, Sequence[int]]:
    """How many tokens a call's prompt keeps of those before it, and what follows them."""
    if "prompt_ids" in row:  # format 1
        kept, *new = row["prompt_ids"]
        return kept, new
    return row["prompt"]["kept"], row["prompt"]["new"]
