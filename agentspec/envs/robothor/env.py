"""RoboTHOR object navigation for language agents: a class to find, six actions, success by stopping in view of it.

Success: the agent says stop while an object of the class is visible, that is within the success distance, in the
picture and unobstructed. Metrics: `success` and `spl` = success * l / max(p, l), with l the shortest path's length from
the episode file and p the metres walked (Anderson et al., 2018). Presets:

- `paper`: moves of 0.25 m, turns of 90 degrees, field of view 90, 200 steps, success within 1.5 m;
- `challenge2021`: turns of 30 degrees, vertical field of view 63.453, 640 x 480, 500 steps, success within 1.0 m;
- `casestudy`: as `paper`, with moves of 0.5 m and turns of 45 degrees, as the paper's printed trace has them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from agentspec.envs.robothor.episodes import VALIDATION, Episode, own_episodes, read_episodes, scene_of
from agentspec.envs.thor import homes, mining
from agentspec.envs.thor.engine import OfflineThor, Settings
from agentspec.envs.thor.game import Game, Told, check
from agentspec.envs.thor.geodesic import distances
from agentspec.envs.thor.names import Names, direction, whereabouts, words
from agentspec.envs.thor.scene import Scene, cell_at
from agentspec.envs.thor.sight import Camera
from agentspec.metrics import Metric
from agentspec.types import Action, ActionSchema, ActionSpec

HEIGHT = 0.87
"""Camera height of the robot, metres; not verified against the simulator."""


@dataclass(frozen=True)
class Preset:
    """How it is played: the player's settings and the budget."""

    settings: Settings
    max_steps: int


def _preset(turn: float, fov: float, reach: float, steps: int, grid: float = 0.25, size: Any = (300, 300)) -> Preset:
    camera = Camera(HEIGHT, fov, size[0] / size[1])
    settings = Settings(
        grid=grid,
        rotate_step=turn,
        horizon=(-30.0, 60.0),
        visibility=reach,
        width=size[0],
        height=size[1],
        camera=camera,
        slack=reach,
    )
    return Preset(settings, steps)


PRESETS: dict[str, Preset] = {
    "paper": _preset(90.0, 90.0, 1.5, 200),
    "challenge2021": _preset(30.0, 63.453, 1.0, 500, size=(640, 480)),
    "casestudy": _preset(45.0, 90.0, 1.5, 200, grid=0.5),
}

CALLS = {
    "MOVE_AHEAD": ("MoveAhead", "move ahead", "moved ahead"),
    "ROTATE_LEFT": ("RotateLeft", "turn left", "turned left"),
    "ROTATE_RIGHT": ("RotateRight", "turn right", "turned right"),
    "LOOK_UP": ("LookUp", "look up", "looked up"),
    "LOOK_DOWN": ("LookDown", "look down", "looked down"),
    "STOP": ("Stop", "stop", "stopped"),
}
"""Native call -> the player's action, its words on the menu, what is said of it."""

RULES = """You drive a robot through an apartment, one action at a time. Moves are {grid:g} m, turns {turn:g} degrees, \
the camera looks up or down by 30 degrees. Yaw 0 looks to +z, 90 to +x.
Find an object of the class "{target}" and stop when it is in view within {reach:g} m: stopping ends the episode.
You have {steps} steps; shorter ways are better."""


class RoboThorEnv(Game):
    """One apartment, one class of objects to find.

    Args:
        preset: `paper`, `challenge2021` or `casestudy`.
        suite: `own` (ten episodes in our apartment) or `validation` (the fixed ten; needs `data`).
        episode: an episode's id instead of the seed's, `FloorPlan_Val1_1_Apple_0` say; needs `data`.
        data: folder with the challenge's episode files, one `<scene>.json.gz` per scene.
        objects: folder with recorded object metadata; default: `objects` two folders above `data`.
        action_mode: `native` calls, or a `menu` of six phrases.
        reward: `success` (1 for it) or `progress` (besides, metres come nearer to the target over the shortest path's
            length, clipped by the metres moved).
        max_steps: instead of the preset's.
        images: put the egocentric picture into the observation.
        render_mode: None or "rgb_array".

    Raises:
        ValueError: an argument that is none of these.
        NoData: public data that are not where the paths say.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 4,
        "metrics": (
            Metric("success", summary="whether the agent stopped with the target in view (0 or 1)"),
            Metric("spl", heading="SPL", summary="success * l / max(p, l): shortest path over metres walked"),
            Metric("path_length", "m", higher_is_better=False, summary="metres walked"),
            Metric("distance_left", "m", higher_is_better=False, summary="metres to where the target is seen"),
        ),
        "typical_return": 1.0,
    }
    failure_signs: ClassVar[str] = "agentspec.envs.thor.signs:robothor"
    experts: ClassVar[dict[str, str]] = {
        "rule_based": "agentspec.envs.robothor.expert:expert",
        "random": "agentspec.envs.robothor.expert:luck",
    }

    def __init__(
        self,
        *,
        preset: str = "paper",
        suite: Literal["own", "validation"] = "own",
        episode: str = "",
        data: str = "",
        objects: str = "",
        action_mode: Literal["native", "menu"] = "native",
        reward: Literal["success", "progress"] = "success",
        max_steps: int = 0,
        images: bool = False,
        render_mode: str | None = None,
    ) -> None:
        check("preset", preset, tuple(PRESETS))
        check("suite", suite, ("own", "validation"))
        check("action_mode", action_mode, ("native", "menu"))
        check("reward", reward, ("success", "progress"))
        if (suite == "validation" or episode) and not data:
            raise ValueError("data is empty; give the folder with the challenge's episode files (<scene>.json.gz)")
        if max_steps < 0:
            raise ValueError(f"max_steps is {max_steps}; expected at least 1, or 0 for the preset's")
        self.preset = PRESETS[preset]
        self.settings = self.preset.settings
        super().__init__(
            max_steps=max_steps or self.preset.max_steps,
            images=images,
            pixels=(self.settings.width, self.settings.height),
            render_mode=render_mode,
        )
        self._suite, self._id, self._data, self._reward = suite, episode, data, reward
        self._objects = objects or str(Path(data).parent.parent / "objects")
        self._actions = _schema(menu=action_mode == "menu")

    # -- the episode -------------------------------------------------------------------------------------------

    def episode_of(self, seed: int) -> Episode:
        """The episode that a seed starts.

        Raises:
            LookupError: the episode asked for is not in its scene's file.
        """
        if self._suite == "own" and not self._id:
            ours = own_episodes(self.settings.visibility, self.settings.camera)
            return ours[seed % len(ours)]
        wanted = self._id or VALIDATION[seed % len(VALIDATION)]
        found = read_episodes(Path(self._data), scene_of(wanted))
        if wanted not in found:
            raise LookupError(f"there is no episode {wanted!r} in {scene_of(wanted)}; it has {len(found)} others")
        return found[wanted]

    def _scene(self, episode: Episode) -> Scene:
        if episode.id.startswith("own_"):
            return homes.apartment()
        return mining.apartment(episode.scene, self._data, self._objects)

    def _begin(self, seed: int) -> None:
        self.episode = self.episode_of(seed)
        self.world = OfflineThor(self._scene(self.episode), self.settings)
        e = self.episode
        self.world.step({"action": "TeleportFull", "x": e.x, "z": e.z, "rotation": e.yaw, "horizon": e.horizon})
        self.walked, self.won, self.earned = 0.0, False, 0.0
        self.names = Names()
        self.names.add(self.world.observe().metadata["objects"])
        self.left_to_go = distances(self.world.viewpoints(e.target), self.world.scene.cells)[0]

    def _schema(self) -> ActionSchema:
        return self._actions

    def _carry_out(self, action: Action) -> None:
        call = next(name for name, (_, phrase, _) in CALLS.items() if action.name in (name, phrase))
        agent = self.world.state.agent
        x, z, before = agent.x, agent.z, self._distance()
        event = self.act({"action": CALLS[call][0]})
        moved = math.hypot(agent.x - x, agent.z - z)
        self.walked += moved
        if call == "STOP":
            self.stopped, self.won = True, self._in_view()
        after = self._distance()
        if before is not None and after is not None:
            self.earned += max(-moved, min(moved, before - after)) / max(self.episode.length, 1.0)
        # A blocked move is an action like any other, which the fixed menu offers: it only takes a step.
        self.told = Told(CALLS[call][2] if event.success else f"could not {CALLS[call][1]}, {event.error}")

    def _in_view(self) -> bool:
        objects = self.world.observe().metadata["objects"]
        return any(o["visible"] and o["objectType"] == self.episode.target for o in objects)

    def _distance(self) -> float | None:
        agent = self.world.state.agent
        return self.left_to_go.get(cell_at(agent.x, agent.z))

    def _value(self) -> float:
        return float(self.won) + (self.earned if self._reward == "progress" else 0.0)

    # -- reporting ---------------------------------------------------------------------------------------------

    def _describe(self) -> dict[str, Any]:
        metadata = self.world.observe().metadata
        agent, target = metadata["agent"], self.episode.target
        seen = []
        for one in metadata["objects"]:
            if one["visible"]:
                far, bearing = whereabouts(one, agent)
                name = self.names.name(one["objectId"])
                seen.append({"name": name, "type": one["objectType"], "distance": round(far, 2), "bearing": bearing})
        seen.sort(key=lambda o: (o["distance"], o["name"]))
        reach = self.settings.visibility
        shown = "; ".join(f"{o['name']} {o['distance']} m {direction(o['bearing'])}" for o in seen) or "nothing"
        at = agent["position"]
        lines = [
            f"Step {self.steps} of {self.max_steps}. Target: {words(target)}.",
            f"You are at x={at['x']:.2f}, z={at['z']:.2f}, yaw {agent['rotation']['y']:g}, camera "
            f"{agent['cameraHorizon']:g} deg down.",
            f"In view within {reach:g} m: {shown}.",
        ]
        if self.told.message or self.told.error:
            lines.insert(0, f"Last: {self.told.message or self.told.error}.")
        rules = RULES.format(
            grid=self.settings.grid,
            turn=self.settings.rotate_step,
            target=words(target),
            reach=reach,
            steps=self.max_steps,
        )
        if self.offered:
            rules += "\nThe actions are: " + ", ".join(self.offered)
        return {
            "instruction": rules,
            "text": "\n".join(lines),
            "state": {
                "target": target,
                "episode": self.episode.id,
                "seed": self.episode_seed,
                "x": at["x"],
                "z": at["z"],
                "yaw": agent["rotation"]["y"],
                "horizon": agent["cameraHorizon"],
                "visible": seen,
                "steps_left": self.left,
            },
            "success": self.won,
            "metrics": self._metrics(),
        }

    def _metrics(self) -> dict[str, Any]:
        length, p = self.episode.length, self.walked
        spl = None
        if self.stopped or self.truncated:
            spl = float(self.won) * (length / max(p, length) if max(p, length) > 0 else 1.0)
        return {
            "success": float(self.won),
            "spl": spl,
            "path_length": p,
            "distance_left": self._distance(),
            "shortest_path": length,
        }

    # -- exact state -------------------------------------------------------------------------------------------

    def _records(self) -> dict[str, Any]:
        return {"walked": self.walked, "won": self.won, "earned": self.earned}

    def _recall(self, records: Mapping[str, Any]) -> None:
        self.walked, self.won, self.earned = records["walked"], records["won"], records["earned"]


def _schema(*, menu: bool) -> ActionSchema:
    actions = {name: ActionSpec(name, phrase, {}, f"{name}()") for name, (_, phrase, _) in CALLS.items()}
    aliases = {player.upper(): name for name, (player, _, _) in CALLS.items()} | {"DONE": "STOP", "END": "STOP"}
    return ActionSchema(actions, aliases, choices=tuple(c[1] for c in CALLS.values()) if menu else ())
