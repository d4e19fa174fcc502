"""What every household environment shares: text in, one report out, a budget of primitive actions, exact snapshots.

A game plays one episode in one world. Subclasses choose the episode, say which actions there are and what each does in
primitives (the player's own actions), and report. Every primitive counts against the budget, whatever action it came
from; a text that is no action takes one step.
"""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from agentspec.actions import parse_action
from agentspec.envs.shared import ASCII, check, printable
from agentspec.envs.thor.engine import OfflineThor, Settings
from agentspec.envs.thor.mining import NoData
from agentspec.envs.thor.protocol import Event, Thor
from agentspec.envs.thor.scene import Scene
from agentspec.types import Action, ActionError, ActionSchema

MAX_ACTION = 256
SNAPSHOT_VERSION = 1


@dataclass
class Told:
    """What the last step left for the next observation."""

    message: str = ""
    error: str = ""
    code: str = ""


class Game(gymnasium.Env[dict[str, Any], str]):
    """One episode at a time in a household world.

    Args:
        max_steps: primitive actions after which the episode is truncated; success on the last one is a success.
        images: put the egocentric picture into the observation as "image".
        settings: of the player.
        render_mode: None or "rgb_array".
        player: `offline`, or `ai2thor`, the simulator.
        version: of ai2thor that the simulator needs.
        executable: see `simulator.player.Ai2Thor`.
        folders: see there.
    """

    world: Thor

    def __init__(
        self,
        *,
        max_steps: int,
        images: bool,
        settings: Settings,
        render_mode: str | None,
        player: str = "offline",
        version: str = "",
        executable: str = "",
        folders: Mapping[str, str] | None = None,
    ) -> None:
        check("render_mode", render_mode, (None, "rgb_array"))
        check("player", player, ("offline", "ai2thor"))
        if executable and player == "offline":
            raise ValueError(f"executable is {executable!r} but the player is offline; expected player='ai2thor'")
        if max_steps < 1:
            raise ValueError(f"max_steps is {max_steps}; expected at least 1")
        self.max_steps, self.images, self.render_mode = max_steps, images, render_mode
        self.action_space = spaces.Text(max_length=MAX_ACTION, min_length=0)
        shown: dict[str, spaces.Space[Any]] = {"text": spaces.Text(max_length=20_000, charset=ASCII)}
        if images:
            shown["image"] = spaces.Box(0, 255, (settings.height, settings.width, 3), np.uint8)
        self.observation_space = spaces.Dict(shown)
        self.episode_seed: int | None = None
        self.settings = settings
        self._simulator: Any = None
        self._simulated: dict[str, Any] = {"version": version, "executable": executable, "folders": folders or {}}
        self._player = player

    # -- what a game is ----------------------------------------------------------------------------------------

    @abstractmethod
    def _begin(self, seed: int) -> None:
        """Start the episode of `seed`: make `self.world` and the episode's own records."""

    @abstractmethod
    def _schema(self) -> ActionSchema:
        """The actions now."""

    @abstractmethod
    def _carry_out(self, action: Action) -> None:
        """Do an action by calling `act` for each primitive; set `told`."""

    @abstractmethod
    def _describe(self) -> dict[str, Any]:
        """`instruction`, `text`, `state`, `metrics`, `success` now."""

    @abstractmethod
    def _value(self) -> float:
        """The return so far: a step pays by how much it changed."""

    def _over(self) -> bool:
        """Whether the episode has ended by itself."""
        return self.stopped

    def _records(self) -> dict[str, Any]:
        """What a snapshot holds besides the world and the common records."""
        return {}

    def _recall(self, records: Mapping[str, Any]) -> None:
        """Go back to `_records`."""

    def _open(self, name: str, scene: Callable[[], Scene]) -> Thor:
        """The player, at the beginning of a scene (which the simulator has by name)."""
        if self._player == "offline":
            return OfflineThor(scene(), self.settings)
        if self._simulator is None:
            from agentspec.envs.thor.simulator.player import Ai2Thor

            pictures = self.images or self.render_mode is not None
            self._simulator = Ai2Thor(settings=self.settings, pictures=pictures, **self._simulated)
        self._simulator.begin(name)
        player: Thor = self._simulator
        return player

    # -- the Gymnasium interface -------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; the same seed starts the same one. Without a seed the next one of the stream is drawn."""
        super().reset(seed=seed)
        self._start(int(self.np_random.integers(0, 2**31)) if seed is None else seed)
        return self.observe()

    def _start(self, seed: int) -> None:
        self.episode_seed = seed
        self.steps, self.stopped, self.truncated = 0, False, False
        self.history: list[str] = []
        self.told = Told()
        self._begin(seed)
        self._schema_now = self._schema()

    def step(self, action: str) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Carry out one action given as text; no text raises, a text that is no action takes a step.

        After the end nothing happens any more.
        """
        self._running()
        if self._over() or self.truncated:
            observation, info = self.observe()
            return observation, 0.0, self._over(), self.truncated, info
        before = self._value()
        text = str(action)[:MAX_ACTION]
        parsed = parse_action(text, self._schema_now)
        self.history.append(text)
        self.told = Told()
        if isinstance(parsed, ActionError):
            self.act({"action": "Pass"})
            self.told = Told(error=parsed.message, code=parsed.code)
        else:
            self._carry_out(parsed)
        self.truncated = not self._over() and self.steps >= self.max_steps
        self._schema_now = self._schema()
        observation, info = self.observe()
        return observation, self._value() - before, self._over(), self.truncated, info

    def act(self, action: Mapping[str, Any]) -> Event:
        """One primitive of the player: it counts."""
        self.steps += 1
        return self.world.step(action)

    @property
    def offered(self) -> tuple[str, ...]:
        """The choices of the menu now; empty without one."""
        return self._schema_now.choices

    @property
    def left(self) -> int:
        """Primitive actions that are left."""
        return self.max_steps - self.steps

    def observe(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The current observation and info, without stepping (after `restore`, say)."""
        self._running()
        told = self._describe()
        observation: dict[str, Any] = {"text": printable(told.pop("text"))}
        if self.images:
            observation["image"] = self.world.observe().frame
        last = self.told
        return observation, {
            **told,
            "action_schema": self._schema_now,
            "error": last.error,
            "error_code": last.code,
            "message": last.message,
            "invalid": bool(last.error),
        }

    def render(self) -> npt.NDArray[np.uint8] | None:
        """The egocentric picture, uint8 (H, W, 3), with `render_mode="rgb_array"`, else None."""
        self._running()
        return self.world.observe().frame if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """End the simulator, where one plays."""
        if self._simulator is not None:
            self._simulator.close()
            self._simulator = None

    # -- exact state -------------------------------------------------------------------------------------------

    def snapshot(self) -> bytes:
        """The exact state as bytes."""
        self._running()
        state = {
            "version": SNAPSHOT_VERSION,
            "seed": self.episode_seed,
            "world": self.world.snapshot().decode(),
            "steps": self.steps,
            "stopped": self.stopped,
            "truncated": self.truncated,
            "history": self.history,
            "told": asdict(self.told),
            "records": self._records(),
        }
        return json.dumps(state, separators=(",", ":"), sort_keys=True).encode()

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot`.

        Raises:
            ValueError: the bytes are no snapshot of this kind of environment.
        """
        try:
            state = json.loads(blob)
            if state["version"] != SNAPSHOT_VERSION:
                raise ValueError(f"got a snapshot of version {state['version']}; this reads {SNAPSHOT_VERSION}")
            if state["seed"] != self.episode_seed:
                self._start(int(state["seed"]))
            self.world.restore(state["world"].encode())
            self.steps, self.stopped, self.truncated = state["steps"], state["stopped"], state["truncated"]
            self.history, self.told = list(state["history"]), Told(**state["told"])
            self._recall(state["records"])
        except (KeyError, TypeError, json.JSONDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"these bytes are no snapshot of {type(self).__name__} ({error!r})") from error
        self._schema_now = self._schema()

    def _running(self) -> None:
        if self.episode_seed is None:
            raise gymnasium.error.ResetNeeded("call reset() before anything else")


def check_index(name: str, value: int, least: int, most: int | None) -> None:
    """Refuse a number out of its range; `most` None: no upper bound.

    Raises:
        ValueError: it is.
    """
    if value < least or (most is not None and value > most):
        span = f"at least {least}" if most is None else f"{least} to {most}" if most > least else f"{least}"
        raise ValueError(f"{name} is {value}; expected {span} with the other options as they are")


def check_folders(used: bool, **folders: str) -> None:
    """Refuse folders that are named and not there, or that nothing would be read from.

    Raises:
        NoData: there is no such folder.
        ValueError: what is played reads no public data.
    """
    for name, folder in folders.items():
        if folder and not used:
            raise ValueError(
                f"{name} is {folder!r}, but the suite `own` reads no data; leave it out, or choose another"
            )
        if folder and not Path(folder).is_dir():
            raise NoData(f"{name} is {folder!r}: there is no such folder")
