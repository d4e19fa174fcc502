"""What an environment owes the scaffold, and one check over every environment.

An environment is a `gymnasium.Env` that speaks text:

- `observation` is a mapping with `text`: the dynamic part of the prompt. It may hold `image`, `uint8` (H, W, 3).
- `step(action)` takes any text. A text that is no action, or an action that cannot be done now, is a step like any
  other: nothing raises, `info["invalid"]` is set and `info["error"]` says what to write instead.
- `info` holds the keys of `INFO_KEYS`, from `reset` on.
- `reset(seed=s)` and the same texts give the same episode, whatever was played before. After the end, `step` changes
  nothing.
- The class's `metadata` declares `metrics` (`agentspec.metrics.Metric`, the primary one first) and `typical_return`
  (above 0: the return of a good episode, by which searches scale rewards).

Optional is `episode_key(options, seed) -> Hashable`, a static method of the class: the name of the episode that a seed
starts in an environment made with these options. Where seeds repeat episodes (a fixed suite, a small level), those that
start the same have the same name; how an episode is shown, worded or cut short is no part of it. It is called for every
task of a configuration, so it should take about a millisecond. Without it every seed is an episode of its own.

Two things are optional, as methods of the innermost environment (`env.unwrapped`):

- `snapshot() -> bytes` and `restore(blob)`: the exact state, random generators included. Searches in the environment
  need them.
- `deliberate(calls, tokens)`: called before each step with what the decision took, by environments in which time passes
  while the agent thinks. They report it as `info["thought"] = [calls, tokens]`, so that an episode can be replayed.

`check_environment` holds an environment against all of this. It knows no environment: it acts by what the action schema
offers.
"""

from __future__ import annotations

import copy
import json
import math
import pickle
import random
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from agentspec.actions import parse_action
from agentspec.envs.making import make_env
from agentspec.metrics import Metric
from agentspec.trajectory import jsonable
from agentspec.types import Action, ActionSchema, ActionSpec, Task


@dataclass(frozen=True)
class InfoKey:
    """A key of `info`: what type its value has, whether it must be there, and what it means."""

    name: str
    type: type | tuple[type, ...]
    required: bool
    meaning: str


INFO_KEYS: tuple[InfoKey, ...] = (
    InfoKey("instruction", str, True, "the static part of the prompt: world, rules, aim; the same at every step"),
    InfoKey("action_schema", ActionSchema, True, "the actions, their parameters and examples; `choices` make a menu"),
    InfoKey("state", Mapping, True, "what the agent may know as JSON data, for scripted agents and perception"),
    InfoKey("metrics", Mapping, True, "figures of the episode so far, those that the class declares among them"),
    InfoKey("invalid", bool, True, "whether the last text was no action or could not be done"),
    InfoKey("error", str, True, "why, and what to write instead; empty if the last text was carried out"),
    InfoKey("message", str, True, "what the last action led to, in words; empty after `reset`"),
    InfoKey("error_code", str, False, "a short name of the error, for counting"),
    InfoKey("success", bool, False, "whether the task is achieved; ends searches and decides what a failed trial is"),
    InfoKey("events", (list, tuple), False, "names of what happened in the step, for rewards"),
    InfoKey("thought", (list, tuple), False, "calls and tokens that were charged to the step (see `deliberate`)"),
    InfoKey("balance", (int, float), False, "money or points held, for rewards by its change"),
    InfoKey("goal_conditions", (int, float), False, "share of the goal conditions met, for rewards by its change"),
    InfoKey("geodesic", Mapping, False, "metres on foot to the target: start, left, walked, shortest; for rewards"),
)
"""The keys the scaffold reads; an environment may report more (JSON values), which trajectories keep."""

NONSENSE = ("", "no action at all (((", "UNHEARD_OF(1)")
"""Texts that are no action in any environment."""

_Report = tuple[Any, float, bool, bool, Mapping[str, Any]]


class ContractError(ValueError):
    """An environment that does not keep the contract: all that is wrong with it."""


def check_environment(env: Any, *, seed: int = 0, steps: int = 30) -> None:
    """Hold an environment against the contract.

    Args:
        env: an environment, a `Task`, or a name (`deliverybench`, `CartPole-v1`, `module:Id-v0`). Give it options that
            let an episode end within `steps`, or what happens after the end stays unseen.
        seed: of the episode that is played.
        steps: most steps to play.

    Raises:
        ContractError: what is wrong, one line each.
    """
    given = make_env(Task(env)) if isinstance(env, str) else make_env(env) if isinstance(env, Task) else env
    problems = list(dict.fromkeys(_problems(given, seed, steps)))
    if problems:
        name = env if isinstance(env, str) else type(getattr(given, "unwrapped", given)).__name__
        listed = "\n".join(f"- {problem}" for problem in problems)
        raise ContractError(f"{name} does not keep the environment contract:\n{listed}")


def _problems(env: Any, seed: int, steps: int) -> Iterator[str]:
    """Everything that is wrong; an exception of the environment is a problem and ends that check only."""
    for check in (_declares, _shows, _refuses, _offers, _repeats, _copies, _snapshots, _deliberates, _ends):
        problems: list[str] = []
        try:
            for problem in check(env, seed, steps):
                problems.append(problem)
        except _Unreadable:
            yield from problems
            return
        except Exception as error:
            problems.append(f"{check.__name__.strip('_')}: raised {type(error).__name__}: {error}")
        yield from problems


class _Unreadable(Exception):  # noqa: N818  (a signal, not an error that anybody sees)
    """Nothing further can be checked of an environment without text or schema."""


def _declares(env: Any, seed: int, steps: int) -> Iterator[str]:
    metrics = env.metadata.get("metrics", ())
    if not all(isinstance(m, Metric) for m in metrics):
        yield f"metadata['metrics'] is {metrics!r}; expected a tuple of agentspec.metrics.Metric"
    scale = env.metadata.get("typical_return", 1.0)
    if not isinstance(scale, (int, float)) or not math.isfinite(scale) or scale <= 0:
        yield f"metadata['typical_return'] is {scale!r}; expected a number above 0"


def _shows(env: Any, seed: int, steps: int) -> Iterator[str]:
    """Observation and info, at the start and after a step."""
    observation, info = env.reset(seed=seed)
    yield from _readable(env, observation, info, "after reset")
    text = _some_action(info, random.Random(seed))
    observation, reward, terminated, truncated, told = env.step(text)
    where = f"after {text!r}"
    yield from _readable(env, observation, told, where)
    if isinstance(reward, bool) or not isinstance(reward, (int, float, np.number)) or not math.isfinite(reward):
        yield f"{where}: the reward is {reward!r}; expected a finite number"
    for name, flag in (("terminated", terminated), ("truncated", truncated)):
        if not isinstance(flag, (bool, np.bool_)):
            yield f"{where}: {name} is {flag!r}; expected a bool"
    if told.get("instruction") != info.get("instruction"):
        yield "info['instruction'] changes from step to step; what changes belongs to observation['text']"


def _readable(env: Any, observation: Any, info: Any, where: str) -> Iterator[str]:
    if not isinstance(observation, Mapping) or not isinstance(observation.get("text"), str) or not observation["text"]:
        yield f"{where}: the observation has no text; expected a mapping with a non-empty 'text'"
    elif not env.observation_space.contains(observation):
        yield f"{where}: the observation is not in the observation space {env.observation_space}"
    for key in INFO_KEYS:
        if key.name not in info:
            if key.required:
                yield f"{where}: info has no {key.name!r} ({key.meaning})"
        elif info[key.name] is not None and not isinstance(info[key.name], key.type):
            yield f"{where}: info[{key.name!r}] is a {type(info[key.name]).__name__}; expected {_type_name(key.type)}"
    if not info.get("instruction"):
        yield f"{where}: info['instruction'] is empty; say what the agent is and what it is to achieve"
    if bool(info.get("invalid")) != bool(info.get("error")):
        yield f"{where}: invalid is {info.get('invalid')!r}, error is {info.get('error')!r}; set both or neither"
    schema = info.get("action_schema")
    if isinstance(schema, ActionSchema) and not schema.actions and not schema.choices:
        yield f"{where}: the action schema offers no action"
        raise _Unreadable
    if (
        not isinstance(schema, ActionSchema)
        or "text" not in observation
        or "metrics" not in info
        or "state" not in info
    ):
        raise _Unreadable
    try:
        json.dumps(jsonable({k: v for k, v in info.items() if k != "action_schema"}), allow_nan=False)
    except (TypeError, ValueError) as error:
        yield f"{where}: info is not JSON data ({error})"


def _refuses(env: Any, seed: int, steps: int) -> Iterator[str]:
    """Texts that are no action: a step with an error that the agent can read."""
    env.reset(seed=seed)
    for text in NONSENSE:
        _, _, terminated, truncated, info = env.step(text)
        if not info.get("invalid") or not info.get("error"):
            yield f"the text {text!r} is no action; expected info['invalid'] and an info['error'] with what to write"
        if terminated or truncated:
            return


def _offers(env: Any, seed: int, steps: int) -> Iterator[str]:
    """What the schema shows can be written, and what the menu shows can be done."""
    _, info = env.reset(seed=seed)
    schema: ActionSchema = info["action_schema"]
    for name, spec in schema.actions.items():
        if name != name.upper() or spec.name != name:
            yield f"action {name!r}: expected an upper-case name that equals its spec's ({spec.name!r})"
        for example in examples(spec):
            parsed = parse_action(example, ActionSchema(schema.actions, schema.aliases, schema.units))
            if not isinstance(parsed, Action) or parsed.name != name:
                yield f"the example {example!r} of action {name} does not read as it"
    shown, told = env.reset(seed=seed)
    text = f"{shown.get('text', '')}\n{told.get('instruction', '')}"
    for number, choice in enumerate(schema.choices):
        if not isinstance(parse_action(choice, schema), Action):
            yield f"the menu's {choice!r} does not read as an action"
        if choice not in text:
            yield f"the menu's {choice!r} stands neither in the observation's text nor in the instruction"
        _, again = env.reset(seed=seed)
        told = env.step(again["action_schema"].choices[number])[4]
        if told["invalid"]:
            yield f"the menu's {choice!r} cannot be carried out: {told['error']}"


def _repeats(env: Any, seed: int, steps: int) -> Iterator[str]:
    """The same seed and texts, the same episode, whatever was played in between."""
    first = _play(env, seed, steps, random.Random(seed))
    env.reset(seed=seed + 1)
    yield from _differences(first, _play(env, seed, steps, random.Random(seed)), "played again with the same seed")


def _copies(env: Any, seed: int, steps: int) -> Iterator[str]:
    """Copies and pickles of a running environment go on alike (vector environments and workers make them)."""
    copiers: tuple[tuple[str, Callable[[Any], Any]], ...] = (
        ("deepcopy", copy.deepcopy),
        ("pickle", lambda e: pickle.loads(pickle.dumps(e))),  # of the environment at hand, never of a file
    )
    for name, copier in copiers:
        info = env.reset(seed=seed)[1]
        try:
            twin = copier(env)
        except Exception as error:
            yield f"{name} after reset raised {type(error).__name__}: {error}"
            continue
        mine = _go_on(env, info, 5, random.Random(seed))
        yield from _differences(mine, _go_on(twin, info, 5, random.Random(seed)), f"going on from a {name}")


def _snapshots(env: Any, seed: int, steps: int) -> Iterator[str]:
    """A snapshot restored is the state it was taken of: the same bytes, the same future."""
    world = getattr(env, "unwrapped", env)
    has = [callable(getattr(world, name, None)) for name in ("snapshot", "restore")]
    if not any(has):
        return
    if not all(has):
        yield "snapshot and restore belong together; only one of them is there"
        return
    last = _play(env, seed, 1, random.Random(seed))[-1]
    info = env.reset(seed=seed)[1] if last[2] or last[3] else last[4]
    blob = world.snapshot()
    if not isinstance(blob, bytes):
        yield f"snapshot() gave a {type(blob).__name__}; expected bytes"
        return
    mine = _go_on(world, info, 5, random.Random(seed))
    world.restore(blob)
    if world.snapshot() != blob:
        yield "restore(snapshot()) changes the snapshot: not everything that it holds is put back"
    again = _go_on(world, info, 5, random.Random(seed))
    yield from _differences(mine, again, "restored from a snapshot")


def _deliberates(env: Any, seed: int, steps: int) -> Iterator[str]:
    """Where thinking is charged, the charge of each step stands in its report."""
    deliberate = getattr(getattr(env, "unwrapped", env), "deliberate", None)
    if not callable(deliberate):
        return
    info = env.reset(seed=seed)[1]
    deliberate(2, 10)
    told = list(env.step(_some_action(info, random.Random(seed)))[4].get("thought") or ())
    if told != [2, 10]:
        yield f"after deliberate(2, 10) the step reports info['thought'] {told}; expected [2, 10]"


def _ends(env: Any, seed: int, steps: int) -> Iterator[str]:
    """What is declared is reported, and a step after the end changes nothing."""
    reports = _play(env, seed, steps, random.Random(seed))
    _, _, terminated, truncated, info = reports[-1]
    for metric in env.metadata.get("metrics", ()):
        if metric.name not in info["metrics"]:
            yield f"the declared metric {metric.name!r} is not reported in info['metrics']"
    if not (terminated or truncated):
        return
    for text in (_some_action(info, random.Random(seed)), NONSENSE[0]):
        after = env.step(text)
        if float(after[1]) != 0.0:
            yield f"a step after the end pays {after[1]}; expected 0"
        if (bool(after[2]), bool(after[3])) != (bool(terminated), bool(truncated)):
            yield f"a step after the end reports another end: {(terminated, truncated)} became {(after[2], after[3])}"
        for what, mine, theirs in (
            ("metrics", info["metrics"], after[4]["metrics"]),
            ("state", info["state"], after[4]["state"]),
        ):
            if jsonable(mine) != jsonable(theirs):
                yield f"a step after the end changes the {what}"


def examples(spec: ActionSpec) -> list[str]:
    """The calls that an action's `example` shows: one, or several as in `WAIT(60) or WAIT("charge_done")`."""
    return re.split(r"(?<=\)) or (?=[A-Z_]+\()", spec.example)


# -- playing ---------------------------------------------------------------------------------------------------------


def _some_action(info: Mapping[str, Any], rng: random.Random) -> str:
    """A text that the schema offers: a choice of the menu, else an example."""
    schema: ActionSchema = info["action_schema"]
    return rng.choice(list(schema.choices) or [text for spec in schema.actions.values() for text in examples(spec)])


def _play(env: Any, seed: int, steps: int, rng: random.Random) -> list[_Report]:
    """An episode of at most `steps` steps, `reset` first (with reward 0)."""
    observation, info = env.reset(seed=seed)
    return [(observation, 0.0, False, False, info), *_go_on(env, info, steps, rng)]


def _go_on(env: Any, info: Mapping[str, Any], steps: int, rng: random.Random) -> list[_Report]:
    """Up to `steps` further steps by what the schema offers; fewer if the episode ends."""
    reports: list[_Report] = []
    for _ in range(steps):
        reports.append(env.step(_some_action(info, rng)))
        info = reports[-1][4]
        if reports[-1][2] or reports[-1][3]:
            break
    return reports


def _differences(mine: list[_Report], theirs: list[_Report], what: str) -> Iterator[str]:
    """The first step at which two plays differ, and in what."""
    if len(mine) != len(theirs):
        yield f"{what}, an episode has {len(theirs)} steps instead of {len(mine)}"
    for number, (a, b) in enumerate(zip(mine, theirs, strict=False)):
        pairs = {
            "text": (a[0]["text"], b[0]["text"]),
            "reward": (float(a[1]), float(b[1])),
            "end": ((bool(a[2]), bool(a[3])), (bool(b[2]), bool(b[3]))),
            "choices": (a[4]["action_schema"].choices, b[4]["action_schema"].choices),
            "state": (jsonable(a[4]["state"]), jsonable(b[4]["state"])),
            "metrics": (jsonable(a[4]["metrics"]), jsonable(b[4]["metrics"])),
        }
        different = [name for name, (left, right) in pairs.items() if left != right]
        if different:
            name = different[0]
            before, after = pairs[name]
            yield f"{what}, step {number} differs in {', '.join(different)}: {before!r} became {after!r}"
            return


def _type_name(kind: type | tuple[type, ...]) -> str:
    return " or ".join(k.__name__ for k in (kind if isinstance(kind, tuple) else (kind,)))
