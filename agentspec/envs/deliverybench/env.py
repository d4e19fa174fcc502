"""DeliveryBench as a Gymnasium environment: text in, text out, dollars as reward.

An observation is the dynamic text (and optionally the map as an image); everything static stands in
`info["instruction"]`, everything structured in `info["state"]`. The reward of a step is the change of the balance, so
the return of an episode is the net earnings. The end of the shift is the task's natural end (`terminated`); running out
of steps or of allowed actions is not (`truncated`).

In menu mode (`action_mode="menu"`) the action is one of `info["action_schema"].choices`; a native call is accepted too.
An answer in JSON may carry a plan, `{"action": "WAIT(60)", "plan": "then fetch order 3"}`, which full texts show again.
`snapshot` and `restore` are exact, so that a search can try actions and groups of rollouts can start alike; copies and
pickles of an environment rest on them.
"""

from __future__ import annotations

import json
import string
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from agentspec.envs.deliverybench import STEP_LIMIT
from agentspec.envs.deliverybench.city.generate import city_of
from agentspec.envs.deliverybench.outcome import MAX_ACTION, Last
from agentspec.envs.deliverybench.view.cards import OfferCards, describe, state_hash
from agentspec.envs.deliverybench.view.compact import compact_text, menu_text
from agentspec.envs.deliverybench.view.full import around, full_text
from agentspec.envs.deliverybench.view.instruction import instruction
from agentspec.envs.deliverybench.view.menu import MORE, Option, pages
from agentspec.envs.deliverybench.world.engine import World
from agentspec.envs.deliverybench.world.events import Progress, events_since
from agentspec.envs.deliverybench.world.grammar import advertised, understood
from agentspec.envs.deliverybench.world.rules import Rules, rules_named
from agentspec.envs.deliverybench.world.thinking import ThinkTime
from agentspec.envs.shared import check, printable
from agentspec.metrics import Metric
from agentspec.shapes import plan_of
from agentspec.types import ActionError, ActionSchema

CHARSET = string.printable
MAX_TEXT = 100_000
SHORTEST_PLAYED_H = 1.0 / 60.0
"""Least time that the profit of a cut episode is divided by."""

SNAPSHOT_VERSION = 2

Point = tuple[float, float]
Observation = dict[str, Any]


class DeliveryBenchEnv(gymnasium.Env[Observation, str]):
    """One courier, one shift.

    Args:
        map: folder of a city in the benchmark's format; None takes a generated city.
        size, city_seed: of the generated city ("tiny", "small", "medium", "large"; see `generate`).
        rules: "fair", "original" or a `Rules` object.
        shift_hours: length of the shift in simulated hours.
        observation: "full" or "compact" text.
        action_mode: "native" calls, or one of a "menu" of choices.
        max_steps: steps after which the episode is truncated, at most `STEP_LIMIT`; None leaves the rules' limit of
            actions. The figures per hour of an episode cut like this divide by the time played.
        order_seed: "seed" (orders follow the reset seed), "original" (the one sequence of the original runner, whatever
            the seed), or a number.
        start_battery: battery of the scooter at the start (%), None as the rules say.
        think_time: "paused", or seconds of the shift that deliberation costs: {"call": s, "token": s} (see `ThinkTime`
            and `deliberate`).
        render_mode: None or "rgb_array".
        images: put the map picture into the observation as "image", uint8 (480, 720, 3).

    Raises:
        ValueError: an argument that is none of these.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 4,
        "metrics": (
            Metric("hourly_profit", "$/h", summary="growth of the balance per hour of the shift, or played if cut"),
            Metric("net_earnings", "$", summary="growth of the balance"),
            Metric("deliveries", summary="orders delivered"),
        ),
        "typical_return": 50.0,
    }
    failure_signs: ClassVar[str] = "agentspec.envs.deliverybench.signs:signs"
    experts: ClassVar[dict[str, str]] = {
        "rule_based": "agentspec.envs.deliverybench.expert.scripted:expert",
        "random": "agentspec.envs.deliverybench.expert.scripted:luck",
    }

    def __init__(
        self,
        *,
        map: str | Path | None = None,
        size: str = "small",
        city_seed: int = 0,
        rules: str | Rules = "fair",
        shift_hours: float = 1.0,
        observation: Literal["full", "compact"] = "full",
        action_mode: Literal["native", "menu"] = "native",
        max_steps: int | None = None,
        order_seed: int | str | None = "seed",
        start_battery: float | None = None,
        think_time: str | Mapping[str, float] | ThinkTime = "paused",
        render_mode: str | None = None,
        images: bool = False,
    ) -> None:
        check("observation", observation, ("full", "compact"))
        check("action_mode", action_mode, ("native", "menu"))
        check("render_mode", render_mode, (None, "rgb_array"))
        if isinstance(order_seed, str):
            check("order_seed", order_seed, ("seed", "original"))
        if not 0 < shift_hours < float("inf"):
            raise ValueError(f"shift_hours is {shift_hours}; expected a number above 0")
        if max_steps is not None and not 1 <= max_steps <= STEP_LIMIT:
            raise ValueError(f"max_steps is {max_steps}; expected 1 to {STEP_LIMIT}, or None")
        self._arguments = {
            "map": map,
            "size": size,
            "city_seed": city_seed,
            "rules": rules,
            "shift_hours": shift_hours,
            "observation": observation,
            "action_mode": action_mode,
            "max_steps": max_steps,
            "order_seed": order_seed,
            "start_battery": start_battery,
            "think_time": think_time,
            "render_mode": render_mode,
            "images": images,
        }
        self.city = city_of(map, size, city_seed)
        self.rules = _adapted(rules_named(rules), max_steps, start_battery)
        self.think_time = ThinkTime.of(think_time)
        self.shift_hours = shift_hours
        self.compact = observation == "compact"
        self.menu_mode = action_mode == "menu"
        self.max_steps = max_steps
        self.order_seed = order_seed
        self.render_mode = render_mode
        self.images = images
        self.instruction = instruction(self.city, self.rules, shift_hours, self.compact, self.menu_mode)
        self.action_space = spaces.Text(max_length=MAX_ACTION, min_length=0, charset=CHARSET)
        text = spaces.Text(max_length=MAX_TEXT, min_length=1, charset=CHARSET)
        shown: dict[str, spaces.Space[Any]] = {"text": text}
        if images:
            from agentspec.envs.deliverybench.view.render import HEIGHT, WIDTH

            shown["image"] = spaces.Box(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
        self.observation_space = spaces.Dict(shown)
        self._world: World | None = None

    # -- the Gymnasium interface -------------------------------------------------------------------------------

    @property
    def world(self) -> World:
        """The running world.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._world is None:
            raise gymnasium.error.ResetNeeded("call reset() before anything else")
        return self._world

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a shift; the same seed starts the same one. Without a seed the next one of the stream is drawn."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(0, 2**31))
        orders = seed if self.order_seed == "seed" else None if self.order_seed == "original" else self.order_seed
        assert orders is None or isinstance(orders, int)
        self._world = World(self.city, self.rules, orders, self.shift_hours)
        self._cards = OfferCards(self._world.book)
        self._steps = self._page = 0
        self._plan = ""
        self._thought: tuple[int, int] | None = None
        self._last = Last()
        self._track: list[list[float | str]] = [[self._world.state.mode, *self._world.state.position]]
        return self.observe()

    def deliberate(self, calls: int = 1, tokens: int = 0) -> None:
        """Report what the next action took to decide: model calls and tokens written, charged as `think_time` says.

        A step that nobody reported on counts as one call.

        Raises:
            ValueError: negative numbers.
        """
        if calls < 0 or tokens < 0:
            raise ValueError(f"got {calls} calls and {tokens} tokens; expected numbers of at least 0")
        self._thought = (int(calls), int(tokens))

    def step(self, action: str) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carry out one action given as text; no text raises. After the end nothing happens any more."""
        world = self.world
        text = str(action)
        if self._terminated or self._truncated:
            observation, info = self.observe(Last.after_end(text))
            return observation, 0.0, self._terminated, self._truncated, info
        call, problem = self._native(text)
        before = Progress.of(world)
        balance = world.state.balance
        mode = world.state.mode
        thought, self._thought = self._thought or (1, 0), None
        turned = self.menu_mode and call == MORE.call and not problem
        if turned:
            outcome = world.pause("more choices", self.think_time.seconds(*thought))
        else:
            outcome = world.step(call, self.think_time.seconds(*thought))
        self._page = self._page + 1 if turned else 0
        self._plan = plan_of(text) or self._plan
        self._steps += 1
        self._last = Last.of(outcome, call, problem, events_since(before, world, outcome), thought)
        if world.state.position != tuple(self._track[-1][1:]):
            self._track.append([mode, *world.state.position])
        observation, info = self.observe()
        return observation, world.state.balance - balance, self._terminated, self._truncated, info

    def observe(self, last: Last | None = None) -> tuple[Observation, dict[str, Any]]:
        """The current observation and info, without stepping (after `restore`, say).

        `last` is what info says of the last step, if that is not the step that led here.
        """
        world, last = self.world, last or self._last
        view = self._view()
        self._menu = self._options(view)
        observation: Observation = {"text": printable(self._text(view), CHARSET)[:MAX_TEXT]}
        if self.images:
            observation["image"] = self._picture()
        schema = replace(advertised(world.schema), choices=tuple(self._menu))
        return observation, self._info(view, schema, last)

    @property
    def page(self) -> int:
        """How often "more choices" has been asked for since the last action."""
        return self._page

    @property
    def menu(self) -> tuple[Option, ...]:
        """The choices on offer in menu mode, as they stand in `info["action_schema"].choices`."""
        return tuple(self._menu.values())

    def render(self) -> npt.NDArray[np.uint8] | None:
        """The map as uint8 (H, W, 3) with `render_mode="rgb_array"`, else None."""
        return self._picture() if self.render_mode == "rgb_array" else None

    # -- exact state -------------------------------------------------------------------------------------------

    def snapshot(self) -> bytes:
        """The exact state as bytes, for `restore` into an environment with the same arguments and reset seed."""
        world = self.world
        state = {
            "version": SNAPSHOT_VERSION,
            "seed": world.seed,
            "world": world.snapshot().decode("utf-8"),
            "steps": self._steps,
            "last": self._last.dump(),
            "page": self._page,
            "plan": self._plan,
            "track": self._track,
            "thought": self._thought,
        }
        return json.dumps(state, separators=(",", ":")).encode("utf-8")

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot`.

        Raises:
            ValueError: the bytes are no snapshot of this kind of environment.
        """
        try:
            state = json.loads(blob)
            version, seed = state["version"], state["seed"]
            blob, steps, last, track = state["world"].encode("utf-8"), state["steps"], state["last"], state["track"]
            thought = None if state["thought"] is None else tuple(state["thought"])
            page, plan = state["page"], state["plan"]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"these bytes are no snapshot of a DeliveryBench environment ({error!r})") from error
        if version != SNAPSHOT_VERSION:
            raise ValueError(f"got a snapshot of version {version}; this release reads version {SNAPSHOT_VERSION}")
        if self._world is None or self._world.seed != seed:
            self._world = World(self.city, self.rules, seed, self.shift_hours)
            self._cards = OfferCards(self._world.book)
        self._world.restore(blob)
        self._steps, self._last, self._track, self._thought = steps, Last(**last), track, thought
        self._page, self._plan = page, plan
        self._menu = self._options(self._view()) if self.menu_mode else {}

    def __reduce__(self) -> tuple[Any, ...]:
        blob = None if self._world is None else self.snapshot()
        return _revived, (type(self), self._arguments, self._np_random, self._np_random_seed, blob)

    # -- internals ---------------------------------------------------------------------------------------------

    @property
    def _terminated(self) -> bool:
        return self.world.state.reason == "shift"

    @property
    def _truncated(self) -> bool:
        return not self._terminated and (self.world.state.ended or self._out_of_steps)

    @property
    def _out_of_steps(self) -> bool:
        return self._steps >= (self.max_steps or STEP_LIMIT)

    def _view(self) -> dict[str, Any]:
        """What the courier can know now, with the steps left where they are limited."""
        view = describe(self.world, self._cards)
        if self.max_steps is not None:
            view["calls_left"] = max(0, self.max_steps - self._steps)
        return view

    def _options(self, view: Mapping[str, Any]) -> dict[str, Option]:
        if not self.menu_mode:
            return {}
        found = pages(view)
        return {option.text: option for option in found[self._page % len(found)]}

    def _text(self, view: Mapping[str, Any]) -> str:
        last = self._last
        if self.compact and self.menu_mode:
            # The menu shows what a success led to; only failures and payments need words.
            said = last.error or (last.message if "delivered" in last.events else "")
            return menu_text(view, said, self.menu)
        if self.compact:
            return compact_text(view, last.message)
        surrounding = around(self.city, self.world.state.position, view)
        return full_text(view, surrounding, self._plan, self.menu, message=last.message)

    def _native(self, text: str) -> tuple[str, str]:
        """The native call for an answer, and in menu mode the problem with an answer that is neither."""
        if not self.menu_mode:
            return text, ""
        schema = ActionSchema(
            self.world.schema.actions, self.world.schema.aliases, self.world.schema.units, tuple(self._menu)
        )
        action = understood(text, schema)
        if isinstance(action, ActionError):
            return text, action.message
        chosen: Option | None = self._menu.get(action.name)
        return (text, "") if chosen is None else (chosen.call, "")

    def _info(self, view: dict[str, Any], schema: ActionSchema, last: Last) -> dict[str, Any]:
        world = self.world
        earned = world.state.balance - self.rules.initial_balance
        cut = self._truncated and not world.state.ended
        hours = max(SHORTEST_PLAYED_H, world.seconds / 3600.0) if cut else self.shift_hours
        metrics: dict[str, Any] = {
            "net_earnings": earned,
            "deliveries": len(world.state.settlements),
            "clock_s": view["clock_s"],
            "hourly_profit": earned / hours,
            "hours_paid": hours,
            "cut": cut,
            "rules": self.rules.name,
        }
        info: dict[str, Any] = {
            "instruction": self.instruction,
            "action_schema": schema,
            "state": view,
            "balance": world.state.balance,
            "net_earnings": earned,
            "error": last.error,
            "error_code": last.code,
            "message": last.message,
            "invalid": last.invalid,
            "events": list(last.events),
            "seconds": last.seconds,
            "thought": list(last.thought),
            "native_action": last.call,
            "metrics": metrics,
            "rules": self.rules.name,
            "state_hash": state_hash(view),
        }
        if self._terminated or self._truncated:
            report = world.summary(hours if cut else None)
            metrics.update(report["evaluation"])
            info["report"] = report
        return info

    def _picture(self) -> npt.NDArray[np.uint8]:
        from agentspec.envs.deliverybench.view.render import render

        return render(self.world, [(str(mode), (float(x), float(y))) for mode, x, y in self._track])


def _revived(
    kind: type[DeliveryBenchEnv], arguments: dict[str, Any], rng: Any, rng_seed: int | None, blob: bytes | None
) -> DeliveryBenchEnv:
    """A copied or unpickled environment."""
    env = kind(**arguments)
    env._np_random, env._np_random_seed = rng, rng_seed
    if blob is not None:
        env.restore(blob)
    return env


def _adapted(rules: Rules, max_steps: int | None, start_battery: float | None) -> Rules:
    if max_steps is not None:
        rules = replace(rules, max_calls=None)
    if start_battery is None:
        return rules
    if not 0.0 <= start_battery <= 100.0:
        raise ValueError(f"start_battery is {start_battery}; expected percent, 0 to 100")
    return replace(rules, initial_battery=float(start_battery))
