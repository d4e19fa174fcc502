"""The adapter: a Gymnasium environment with a discrete or text action space behind the text contract.

Actions of a `Discrete` space make a menu, shortened by `info["action_mask"]` where the environment gives one; larger
and composite spaces are called as `ACT(...)`. A text that is no action does not reach the environment: the step counts,
pays nothing and says what to write instead.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from agentspec.actions import parse_action
from agentspec.envs.finished import FinishedEpisode
from agentspec.envs.generic.describe import as_json, describe, is_picture, plain
from agentspec.envs.generic.names import Names, names_of
from agentspec.registry import SpecError
from agentspec.types import Action, ActionError, ActionSchema, ActionSpec, Parameter

MENU = 40
"""Most actions of a `Discrete` space that are offered as a menu."""

STEPS = 1000
"""Most steps of an episode where the environment has no limit of its own: refused texts must not go on for ever."""

CALL = "ACT"


class AnyText(spaces.Text):
    """Any string: what an environment says is not ours to restrict."""

    def contains(self, x: Any) -> bool:
        """Whether `x` is a string."""
        return isinstance(x, str)


def keeps_contract(env: Any) -> bool:
    """Whether an environment speaks text by itself: a `text` entry in its observations and texts as actions."""
    seen = env.observation_space
    return isinstance(seen, spaces.Dict) and "text" in seen.spaces and isinstance(env.action_space, spaces.Text)


def adapted(env: Any, name: str) -> Any:
    """`env` itself if it keeps the contract (a limit of steps made to end it), else behind a `TextAdapter`."""
    if not keeps_contract(env):
        return TextAdapter(env, name)
    limited = env.spec is not None and env.spec.max_episode_steps is not None
    return FinishedEpisode(env) if limited and not isinstance(env, FinishedEpisode) else env


class TextAdapter(gymnasium.Env[dict[str, Any], str]):
    """An environment of numbers as one of texts.

    Args:
        env: the environment, as `gymnasium.make` gives it.
        name: its id, for the instruction and for names of its parts.

    Raises:
        SpecError: an action space that no text can name (continuous actions).
    """

    def __init__(self, env: Any, name: str) -> None:
        space = env.action_space
        if not isinstance(space, (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Text)):
            raise SpecError(
                f"{name} takes actions of {space}, which no text names; expected a discrete or text action space. "
                "Write an environment of your own that offers named actions (docs/tutorials/own_environment.md)"
            )
        self.inner = env
        self.name = name
        self.metadata = dict(env.metadata)
        self.render_mode = env.render_mode
        self.spec = env.spec
        self.limit = (env.spec.max_episode_steps if env.spec else None) or STEPS
        self.names: Names = names_of(env.unwrapped, name, int(space.n) if isinstance(space, spaces.Discrete) else 0)
        self._specs = _action_specs(space, self.names)
        self.action_space = AnyText(512, min_length=0)
        shown: dict[str, spaces.Space[Any]] = {"text": AnyText(100_000)}
        picture = _picture_space(env)
        if picture is not None:
            shown["image"] = picture
        self.observation_space = spaces.Dict(shown)
        self._over = True
        self._last: tuple[dict[str, Any], bool, bool, dict[str, Any]] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; the same seed starts the same one, as far as the environment keeps that."""
        super().reset(seed=seed)
        self._steps = 0
        self._seen, self._told = self.inner.reset(seed=seed, options=options)
        return self._show(False, False, "", "")

    def step(self, action: str) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Carry out the action that a text names; no text raises. After the end nothing happens any more."""
        if self._last is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        if self._over:
            observation, terminated, truncated, info = self._last
            return observation, 0.0, terminated, truncated, info
        self._steps += 1
        parsed = parse_action(str(action), self._schema())
        value = parsed if isinstance(parsed, ActionError) else self._value(parsed)
        reward, terminated, truncated, error = 0.0, False, False, ""
        if isinstance(value, ActionError):
            error = value.message
        else:
            self._seen, reward, terminated, truncated, self._told = self.inner.step(value)
        truncated = bool(truncated) or (self._steps >= self.limit and not terminated)
        code = value.code if isinstance(value, ActionError) else ""
        observation, info = self._show(bool(terminated), truncated, error, code)
        return observation, float(reward), bool(terminated), truncated, info

    def render(self) -> Any:
        """What the environment draws."""
        return self.inner.render()

    def close(self) -> None:
        """Close the environment."""
        self.inner.close()

    def _schema(self) -> ActionSchema:
        return ActionSchema(self._specs, choices=self._choices())

    def _choices(self) -> tuple[str, ...]:
        space = self.inner.action_space
        if not isinstance(space, spaces.Discrete) or space.n > MENU:
            return ()
        return tuple(text for text, possible in zip(self.names.actions, self._allowed(), strict=True) if possible)

    def _allowed(self) -> Any:
        """Which actions of a `Discrete` space the environment offers now, shape (n,); all where it masks none."""
        mask = self._told.get("action_mask") if isinstance(self._told, Mapping) else None
        n = int(self.inner.action_space.n)
        return np.ones(n, bool) if mask is None or not np.any(mask) else np.asarray(mask, bool)

    def _value(self, action: Action) -> Any:
        """The element of the action space, or what is wrong with the action's arguments."""
        space = self.inner.action_space
        if isinstance(space, spaces.Discrete) and action.name != CALL:
            named = [action.name in (text, call_name(text)) for text in self.names.actions]
            return self._offered(int(space.start) + named.index(True), action)
        given = [*action.args, *action.kwargs.values()]
        example = self._specs[CALL].example
        if len(given) != 1:
            return ActionError("ARGS", f"{CALL} takes one argument, got {len(given)}; write {example}", action.text)
        value = given[0]
        if not isinstance(space, spaces.Text):
            try:
                value = np.asarray(value, dtype=space.dtype) if space.shape else int(value)
                if not np.array_equal(value, np.asarray(given[0], dtype=float).reshape(space.shape)):
                    value = None  # 2.7 is not 2
            except (TypeError, ValueError, OverflowError):
                value = None
        if value is None or not space.contains(value):
            return ActionError("RANGE", f"{given[0]!r} is none of {space}; write {example}", action.text)
        return self._offered(value, action) if isinstance(space, spaces.Discrete) else value

    def _offered(self, value: int, action: Action) -> Any:
        """`value`, or that the environment does not allow it now: a call may name what the menu leaves out."""
        allowed, start = self._allowed(), int(self.inner.action_space.start)
        if allowed[value - start]:
            return value
        now = [self.names.actions[i] if self._choices() else f"{CALL}({start + i})" for i in np.flatnonzero(allowed)]
        shown = "; ".join(now[:MENU])
        return ActionError("NOT_OFFERED", f"{action.text} is not possible now; possible are {shown}", action.text)

    def _show(self, terminated: bool, truncated: bool, error: str, code: str) -> tuple[dict[str, Any], dict[str, Any]]:
        """The observation and info of now."""
        space = self.inner.observation_space
        text = describe(space, self._seen, self.names.observation)
        choices = self._choices()
        if choices:
            text += f"\nActions: {'; '.join(choices)}"
        observation: dict[str, Any] = {"text": text}
        if "image" in self.observation_space.spaces:  # type: ignore[attr-defined]  # a Dict space
            observation["image"] = self._picture()
        told = as_json(self._told) if isinstance(self._told, Mapping) else {}
        success = told.get("success", told.get("is_success"))
        achieved = {} if success is None else {"success": bool(success)}
        info = {
            **told,
            **achieved,
            "instruction": self._instruction(),
            "action_schema": self._schema(),
            "state": {"observation": plain(space, self._seen), "steps": self._steps},
            "error": error,
            "error_code": code,
            "message": f"failed: {error}" if error else "ok" if self._steps else "",
            "invalid": bool(error),
            "metrics": achieved,
        }
        self._over = terminated or truncated
        self._last = (observation, terminated, truncated, info)
        return observation, info

    def _picture(self) -> Any:
        space = self.inner.observation_space
        if is_picture(space):
            return self._seen
        if isinstance(space, spaces.Dict):
            key = next((k for k, part in space.spaces.items() if is_picture(part)), None)
            if key is not None:
                return self._seen[key]
        return self.inner.render()

    def _instruction(self) -> str:
        aim = f"{self.names.aim} " if self.names.aim else ""
        if isinstance(self.inner.action_space, spaces.Text):
            how = f"answer with {CALL} and the text to send"
        elif isinstance(self.inner.action_space, spaces.Discrete) and self.inner.action_space.n <= MENU:
            how = "answer with one of the actions listed"
        else:
            how = f"answer with {CALL} and an element of {self.inner.action_space}"
        return f"You act in {self.name}. {aim}Collect as much reward as you can. At every step {how}."


def call_name(text: str) -> str:
    """The call that a menu text may also be written as: `push left` is `PUSH_LEFT`."""
    name = re.sub(r"\W+", "_", text).strip("_").upper()
    return name if name[:1].isalpha() else f"ACTION_{name}"


def _action_specs(space: Any, names: Names) -> dict[str, ActionSpec]:
    if isinstance(space, spaces.Discrete) and space.n <= MENU:
        calls = {call_name(text): text for text in names.actions}
        if len(calls) == len(names.actions) and CALL not in calls:
            return {name: ActionSpec(name, text, example=f"{name}()") for name, text in calls.items()}
    if isinstance(space, spaces.Text):
        return {CALL: ActionSpec(CALL, "send a text", {"text": Parameter("str")}, f'{CALL}("look around")')}
    example = np.zeros(space.shape or (), dtype=int) + getattr(space, "start", 0)
    kind: Any = "list" if space.shape else "int"
    return {CALL: ActionSpec(CALL, f"an element of {space}", {"value": Parameter(kind)}, f"{CALL}({example.tolist()})")}


def _picture_space(env: Any) -> spaces.Space[Any] | None:
    """Where a picture comes from: the observation, an entry of it, or what the environment renders as `rgb_array`."""
    space = env.observation_space
    if is_picture(space):
        return space
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else ()
    found = next((part for part in parts if is_picture(part)), None)
    if found is None and env.render_mode == "rgb_array":
        return _Picture()
    return found


class _Picture(spaces.Box):
    """A picture whose size is known only once it is drawn."""

    def __init__(self) -> None:
        super().__init__(0, 255, (1, 1, 3), np.uint8)

    def contains(self, x: Any) -> bool:
        """Whether `x` is an RGB picture of any size."""
        return isinstance(x, np.ndarray) and x.dtype == np.uint8 and x.ndim == 3 and x.shape[2] == 3
