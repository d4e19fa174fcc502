"""MiniGrid and BabyAI for language agents: egocentric text in, named actions out, the environment's own reward.

The world is MiniGrid's, untouched: this class chooses the layout (`agentspec.envs.minigrid.suites`), words what the
agent sees (`view`), reads actions as text and reports what happened. Success is a positive reward, also on the last
step allowed: success beats truncation.

Metrics: `success` (0 or 1), `reward` (MiniGrid's own, `1 - 0.9 * steps / max_steps` on success), and `efficiency` =
success * L* / max(steps, L*), where L* is the fewest actions that solve the layout for somebody who sees all of it,
found by breadth-first search when the first episode on a layout succeeds.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Literal

import gymnasium
import minigrid  # noqa: F401  (registers its environments)
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from agentspec.actions import parse_action
from agentspec.envs.minigrid.search import ACTIONS, actions_of, optimum, start_of
from agentspec.envs.minigrid.suites import Layout, layout_of
from agentspec.envs.minigrid.texts import TEXTS, compact
from agentspec.envs.minigrid.view import Thing, View, look
from agentspec.envs.shared import ASCII, check, printable
from agentspec.metrics import Metric
from agentspec.types import ActionError, ActionSchema, ActionSpec

TILE = 28
"""Pixels of a cell in the first-person picture: 7 x 7 cells are 196 x 196 pixels."""

NO_ACTION = -1
"""In a history: a step that was spent on a text that is no action."""

MAX_ACTION = 256
MOST_STATES = 20_000
"""States that the search for L* looks at before it gives up (some seconds)."""

SNAPSHOT_VERSION = 1

CALLS: Mapping[str, tuple[str, str]] = {
    "TURN_LEFT": ("turn left", "turn 90 degrees to the left, staying in the cell"),
    "TURN_RIGHT": ("turn right", "turn 90 degrees to the right, staying in the cell"),
    "FORWARD": ("go forward", "move one cell in the direction you face"),
    "PICK_UP": ("pick up", "take the key, ball or box in the cell in front of you; you can carry one thing"),
    "DROP": ("drop", "put what you carry into the free cell in front of you"),
    "TOGGLE": (
        "toggle",
        "open or close the door, or open the box, in front of you; a locked door needs its key carried",
    ),
    "DONE": ("done", "say that the mission is fulfilled"),
}
"""Native call -> its menu text and what it does, in the order of MiniGrid's action numbers."""

ALIASES = {
    "LEFT": "TURN_LEFT",
    "RIGHT": "TURN_RIGHT",
    "GO_FORWARD": "FORWARD",
    "MOVE_FORWARD": "FORWARD",
    "MOVEAHEAD": "FORWARD",
    "PICKUP": "PICK_UP",
    "OPEN": "TOGGLE",
    "UNLOCK": "TOGGLE",
    "STOP": "DONE",
}

RULES = """You act in a grid of cells, one action at a time. You see the 7 x 7 cells in front of you; walls block the \
view. Distances are in cells from you: "2 forward, 1 left" is two cells ahead and one to your left.
- You cannot walk into walls, closed doors or objects; such an action only takes a step. Goals can be walked onto.
- Lava ends the episode in failure. If the mission is to avoid it, go around.
- "go to" a door or an object: stand in a cell next to it (facing it is safest), then use done. Toggling it fails.
- "get" or "fetch" an object: pick it up. Picking up a different one fails.
- "get to the goal": walk onto it; done is not needed.
- You have {steps} steps; fewer steps are better."""

MATCHING = """
- "the matching object": two objects stand at the end of the hallway; go next to the one that equals the object in the \
small room at the hallway's other end. Going next to the other one fails."""
"""A rule of the levels whose mission names an object that is to be seen first."""


class MiniGridEnv(gymnasium.Env[dict[str, Any], str]):
    """One grid, one mission.

    Args:
        suite, level, task: what is played, one of the three (see `suites.layout_of`); default the suite `paper`.
        observation: `compact`, `basic` or `relational` text (see `view`).
        action_mode: `native` calls such as `TURN_LEFT()`, or a `menu` of seven phrases.
        max_steps: actions after which an episode is truncated (the paper's 100, whatever MiniGrid's own limit).
        images: put the first-person picture into the observation as "image", uint8 (196, 196, 3).
        render_mode: None or "rgb_array" (the whole grid, with the agent's view lit).

    Raises:
        ValueError: an argument that is none of these.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 4,
        "metrics": (
            Metric("success", summary="whether the mission was fulfilled (0 or 1)"),
            Metric("efficiency", summary="success * L* / max(steps, L*), L* the fewest actions that solve the layout"),
            Metric(
                "reward", summary="MiniGrid's own: 1 - 0.9 * steps / max_steps on success, else 0 (-1: a collision)"
            ),
        ),
        "typical_return": 1.0,
    }
    failure_signs: ClassVar[str] = "agentspec.envs.minigrid.signs:signs"
    expert_notes: ClassVar[str] = "agentspec.envs.minigrid.notes:notes"
    experts: ClassVar[dict[str, str]] = {
        "rule_based": "agentspec.envs.minigrid.expert:expert",
        "random": "agentspec.envs.minigrid.expert:luck",
    }

    @staticmethod
    def episode_key(options: Mapping[str, Any], seed: int) -> str:
        """Name of the episode that a seed starts: its level and what stands where in the beginning."""
        layout = layout_of(**_choice(**{name: options.get(name) for name in ("suite", "level", "task")}), seed=seed)
        return start_of(layout.id, layout.seed)

    def __init__(
        self,
        *,
        suite: str = "",
        level: str = "",
        task: str = "",
        observation: Literal["compact", "basic", "relational"] = "relational",
        action_mode: Literal["native", "menu"] = "native",
        max_steps: int = 100,
        images: bool = False,
        render_mode: str | None = None,
    ) -> None:
        self._choice = _choice(suite, level, task)
        layout_of(**self._choice)
        check("observation", observation, tuple(TEXTS))
        check("action_mode", action_mode, ("native", "menu"))
        check("render_mode", render_mode, (None, "rgb_array"))
        if max_steps < 1:
            raise ValueError(f"max_steps is {max_steps}; expected at least 1")
        self._word = TEXTS[observation]
        self.max_steps = max_steps
        self.images = images
        self.render_mode = render_mode
        self.action_schema = _schema(menu=action_mode == "menu", count=actions_of(level) if level else len(ACTIONS))
        answer = "The actions are: " + ", ".join(self.action_schema.choices) if self.action_schema.choices else ""
        self._rules = "\n".join(p for p in (RULES.format(steps=max_steps), answer) if p)
        self.action_space = spaces.Text(max_length=MAX_ACTION, min_length=0)
        shown: dict[str, spaces.Space[Any]] = {"text": spaces.Text(max_length=10_000, charset=ASCII)}
        if images:
            shown["image"] = spaces.Box(0, 255, (7 * TILE, 7 * TILE, 3), np.uint8)
        self.observation_space = spaces.Dict(shown)
        self.layout: Layout | None = None
        self._env: Any = None
        self._history: list[int] = []

    # -- the Gymnasium interface -------------------------------------------------------------------------------

    @property
    def world(self) -> Any:
        """The running MiniGrid environment, unwrapped.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._env is None:
            raise gymnasium.error.ResetNeeded("call reset() before anything else")
        return self._env.unwrapped

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; the same seed starts the same one. Without a seed the next one of the stream is drawn."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(0, 2**31))
        self._begin(layout_of(**self._choice, seed=seed))
        return self.observe()

    def step(self, action: str) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Carry out one action given as text; no text raises, a text that is no action takes a step.

        After the end nothing happens any more.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        assert self.world is not None
        if self._ended:
            observation, info = self.observe()
            return observation, 0.0, self._terminated, self._truncated, info
        parsed = parse_action(str(action)[:MAX_ACTION], self.action_schema)
        if isinstance(parsed, ActionError):
            reward = self._act(NO_ACTION)
            self._last = _Last(error=parsed.message, code=parsed.code)
        else:
            number = _number(parsed.name)
            before = self._view
            reward = self._act(number)
            self._last = _Last(message=_happened(number, before, self._view))
        observation, info = self.observe()
        return observation, reward, self._terminated, self._truncated, info

    def observe(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The current observation and info, without stepping (after `restore`, say)."""
        world, last = self.world, self._last
        # A model that writes no action needs few words more than that; the whole error stands in `info`.
        said = last.message or ("that was no action" if self._word is compact and last.error else last.error)
        observation: dict[str, Any] = {"text": printable(self._word(self._view, said))}
        if self.images:
            observation["image"] = world.get_pov_render(tile_size=TILE)
        return observation, self._info(self._view)

    def render(self) -> npt.NDArray[np.uint8] | None:
        """The whole grid as uint8 (H, W, 3) with `render_mode="rgb_array"`, else None."""
        if self.render_mode != "rgb_array":
            return None
        picture: npt.NDArray[np.uint8] = self.world.get_frame(highlight=True, tile_size=TILE)
        return picture

    def close(self) -> None:
        """Let go of the grid."""
        if self._env is not None:
            self._env.close()

    # -- exact state -------------------------------------------------------------------------------------------

    def snapshot(self) -> bytes:
        """The exact state as bytes: the layout and every action since, which determine it, random draws included."""
        assert self.world is not None and self.layout is not None
        state = {
            "version": SNAPSHOT_VERSION,
            "layout": asdict(self.layout),
            "history": self._history,
            "last": asdict(self._last),
        }
        return json.dumps(state, separators=(",", ":")).encode()

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot` by playing its actions again (a hundred take about ten milliseconds).

        Raises:
            ValueError: the bytes are no snapshot of this kind of environment.
        """
        try:
            state = json.loads(blob)
            version, layout, history = state["version"], Layout(**state["layout"]), [int(a) for a in state["history"]]
            last = _Last(**state["last"])
            layout_of(level=layout.id)
            if not all(NO_ACTION <= number < len(ACTIONS) for number in history):
                raise ValueError(f"its history has numbers that are no actions: {history}")
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"these bytes are no snapshot of a MiniGrid environment ({error!r})") from error
        if version != SNAPSHOT_VERSION:
            raise ValueError(f"got a snapshot of version {version}; this release reads version {SNAPSHOT_VERSION}")
        if self.layout == layout and self._history == history[: len(self._history)]:
            todo = history[len(self._history) :]
        else:
            self._begin(layout)
            todo = history
        for number in todo:
            self._act(number)
        self._last = last

    @property
    def instruction(self) -> str:
        """Rules of the game, and of the level where it has one of its own."""
        first, _, steps = self._rules.partition("\n- You have")
        matching = MATCHING if self.layout is not None and "Memory" in self.layout.id else ""
        return f"{first}{matching}\n- You have{steps}"

    # -- internals ---------------------------------------------------------------------------------------------

    def _begin(self, layout: Layout) -> None:
        if self._env is None or self.layout is None or self.layout.id != layout.id:
            self.close()
            self._env = gymnasium.make(layout.id, disable_env_checker=True, max_steps=self.max_steps)
        self.layout = layout
        self._env.reset(seed=layout.seed)
        self._view = look(self.world)
        self._history = []
        self._terminated = self._truncated = False
        self._return = 0.0
        self._last = _Last()

    def _act(self, number: int) -> float:
        """One step of the grid (`NO_ACTION`: only time passes); its reward."""
        world, reward = self.world, 0.0
        self._history.append(number)
        if number == NO_ACTION:
            world.step_count += 1
        else:
            world.gen_obs = _no_picture  # the symbolic view that `step` would make is not used
            try:
                _, paid, terminated, _, _ = world.step(number)
            finally:
                del world.gen_obs
            self._terminated, reward = bool(terminated), float(paid)
            self._view = look(world)
        self._return += reward
        self._truncated = not self._terminated and world.step_count >= self.max_steps
        return reward

    @property
    def _ended(self) -> bool:
        return bool(self._terminated or self._truncated)

    def _info(self, view: View) -> dict[str, Any]:
        world, last, layout = self.world, self._last, self.layout
        assert layout is not None
        success = self._return > 0
        metrics: dict[str, Any] = {"success": float(success), "efficiency": None, "reward": self._return}
        if self._terminated or self._truncated:
            metrics |= self._efficiency(layout) if success else {"efficiency": 0.0}
        return {
            "instruction": self.instruction,
            "action_schema": self.action_schema,
            "state": {
                "mission": view.mission,
                "heading": view.heading,
                "carrying": view.carrying,
                "in_front": view.ahead.name if view.ahead else "",
                "affordances": list(view.affordances),
                "in_view": [{"name": t.name, "forward": t.forward, "right": t.right} for t in view.things],
                "steps_left": self.max_steps - int(world.step_count),
                "layout": {"id": layout.id, "seed": layout.seed, "name": layout.name},
                "history": list(self._history),
            },
            "error": last.error,
            "error_code": last.code,
            "message": last.message,
            "invalid": bool(last.error),
            "success": success,
            "metrics": metrics,
        }

    def _efficiency(self, layout: Layout) -> dict[str, float]:
        """L* / max(steps, L*) of a success, and L*; nothing where the grid is too large to search."""
        steps = int(self.world.step_count)
        best = layout.optimal if layout.optimal is not None else optimum(layout.id, layout.seed, MOST_STATES)
        return {} if best is None else {"efficiency": best / max(steps, best), "optimal_steps": float(best)}


def _choice(suite: str | None, level: str | None, task: str | None) -> dict[str, Any]:
    """What is played, of the three that may be given: the suite `paper` if none is."""
    given = {"suite": suite or "", "level": level or "", "task": task or ""}
    return given if any(given.values()) else {**given, "suite": "paper"}


def _no_picture() -> dict[str, Any]:
    return {}


@dataclass(frozen=True)
class _Last:
    """What the last step left for the next observation."""

    message: str = ""
    error: str = ""
    code: str = ""


def _schema(*, menu: bool, count: int) -> ActionSchema:
    """The first `count` of MiniGrid's actions, as calls or as a menu."""
    calls = dict(list(CALLS.items())[:count])
    actions = {name: ActionSpec(name, what, {}, f"{name}()") for name, (_, what) in calls.items()}
    aliases = {name: call for name, call in ALIASES.items() if call in calls}
    schema = ActionSchema(actions, aliases | {phrase.upper(): name for name, (phrase, _) in calls.items()})
    return replace(schema, choices=tuple(phrase for phrase, _ in calls.values())) if menu else schema


def _number(name: str) -> int:
    """MiniGrid's number of a parsed action: a native name, or a phrase of the menu."""
    phrases = [phrase for phrase, _ in CALLS.values()]
    return phrases.index(name) if name in phrases else list(CALLS).index(name)


def _happened(number: int, before: View, after: View) -> str:
    """What an action did, for the next observation."""
    action, ahead = ACTIONS[number], before.ahead
    if action == "forward" and ahead is not None and not {"walk", "deadly"} & set(before.affordances):
        return f"could not go forward, {ahead.name} is in the way"
    if action == "pickup":
        nothing = f"picked up nothing, you already carry {before.carrying}" if before.carrying else "picked up nothing"
        return nothing if after.carrying == before.carrying else f"picked up {after.carrying}"
    if action == "drop":
        return f"dropped {before.carrying}" if before.carrying and not after.carrying else "dropped nothing"
    if action == "toggle":
        return _toggled(ahead, after.ahead)
    return {"left": "turned left", "right": "turned right", "forward": "went forward", "done": "said done"}[action]


def _toggled(ahead: Thing | None, now: Thing | None) -> str:
    if ahead is None or ahead.type not in ("door", "box"):
        return "toggled nothing"
    if now is not None and now.name == ahead.name:
        return f"toggled {ahead.name}, nothing changed"
    return f"toggled {ahead.name}, now {now.name if now else 'nothing'} is in front"


assert len(CALLS) == len(ACTIONS)
