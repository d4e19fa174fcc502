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
from pathlib import Path
from typing import Any, ClassVar, Literal

from agentspec.envs.robothor.episodes import OWN, VALIDATION, Episode, own_episodes, read_episodes, scene_of
from agentspec.envs.robothor.presets import PRESETS
from agentspec.envs.shared import check, come_nearer
from agentspec.envs.thor import homes, mining
from agentspec.envs.thor.game import Game, Told, check_folders
from agentspec.envs.thor.names import Names, direction, whereabouts, words
from agentspec.envs.thor.protocol import Event
from agentspec.envs.thor.scene import Scene
from agentspec.metrics import Metric
from agentspec.types import Action, ActionSchema, ActionSpec

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
        player: `offline`, or `ai2thor`: the simulator, version 5.0.0.
        executable: for `ai2thor`: a program instead of ai2thor's build, or `standin` (see docs/thor.md).

    Raises:
        ValueError: an argument that is none of these.
        NoData: public data that are not where the paths say.
        NoSimulator: at reset, with the player `ai2thor`: it cannot be started.
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

    @staticmethod
    def episode_key(options: Mapping[str, Any], seed: int) -> str:
        """Name of the episode that a seed starts: of the suite its seed modulo their number, or the one `episode`."""
        if options.get("episode"):
            return str(options["episode"])
        own = options.get("suite", "own") == "own"
        return f"own {seed % len(OWN)}" if own else VALIDATION[seed % len(VALIDATION)]

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
        player: Literal["offline", "ai2thor"] = "offline",
        executable: str = "",
    ) -> None:
        check("preset", preset, tuple(PRESETS))
        check("suite", suite, ("own", "validation"))
        check("action_mode", action_mode, ("native", "menu"))
        check("reward", reward, ("success", "progress"))
        if (suite == "validation" or episode) and not data:
            raise ValueError("data is empty; give the folder with the challenge's episode files (<scene>.json.gz)")
        check_folders(suite == "validation" or bool(episode), data=data, objects=objects)
        if max_steps < 0:
            raise ValueError(f"max_steps is {max_steps}; expected at least 1, or 0 for the preset's")
        self.preset = PRESETS[preset]
        self._objects = objects or str(Path(data).parent.parent / "objects")
        super().__init__(
            max_steps=max_steps or self.preset.max_steps,
            images=images,
            settings=self.preset.settings,
            render_mode=render_mode,
            player=player,
            version="5.0.0",
            executable=executable,
            folders={"episodes": data, "objects": self._objects} if data else {},
        )
        self._suite, self._id, self._data, self._reward = suite, episode, data, reward
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
        e = self.episode
        self.world = self._open(e.scene, lambda: self._scene(e))
        start = {"action": "TeleportFull", "x": e.x, "z": e.z, "rotation": e.yaw, "horizon": e.horizon}
        self.event = self.world.step(start)
        if not self.event.success:
            raise ValueError(f"episode {e.id} does not fit scene {e.scene}: {self.event.error}")
        self.walked, self.won = 0.0, False
        self.far = self.level = self.left_to_go = self.world.distance(e.target)
        self.names = Names()
        self.names.add(self.event.metadata["objects"])

    def _schema(self) -> ActionSchema:
        return self._actions

    def _carry_out(self, action: Action) -> None:
        call = next(name for name, (_, phrase, _) in CALLS.items() if action.name in (name, phrase))
        at = self.event.metadata["agent"]["position"]
        event = self.act({"action": CALLS[call][0]})
        now = event.metadata["agent"]["position"]
        moved = math.hypot(now["x"] - at["x"], now["z"] - at["z"])
        self.walked += moved
        if self.level is not None and self.left_to_go is not None:
            self.level -= come_nearer(self.level, self.left_to_go, moved)
        if call == "STOP":
            self.stopped, self.won = True, self._in_view()
        # A blocked move is an action like any other, which the fixed menu offers: it only takes a step.
        self.told = Told(CALLS[call][2] if event.success else f"could not {CALLS[call][1]}, {event.error}")

    def act(self, action: Mapping[str, Any]) -> Event:
        """One primitive: it counts, and may bring the target nearer."""
        self.event = super().act(action)
        if str(action["action"]).startswith("Move"):
            self.left_to_go = self.world.distance(self.episode.target)
        return self.event

    def _in_view(self) -> bool:
        objects = self.event.metadata["objects"]
        return any(o["visible"] and o["objectType"] == self.episode.target for o in objects)

    def _value(self) -> float:
        return float(self.won) + (self._nearer() if self._reward == "progress" else 0.0)

    def _nearer(self) -> float:
        """Metres come nearer since the start over the shortest path's length (at least 1 m).

        `level`, the metres that are paid for, follows the distance (`agentspec.envs.shared.come_nearer`).
        """
        if self.far is None or self.level is None:
            return 0.0
        return (self.far - self.level) / max(self.episode.length, 1.0)

    # -- reporting ---------------------------------------------------------------------------------------------

    def _describe(self) -> dict[str, Any]:
        metadata = self.event.metadata
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
            "geodesic": {
                "start": self.far,
                "left": self.left_to_go,
                "walked": self.walked,
                "shortest": self.episode.length,
            },
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
            "distance_left": self.left_to_go,
            "shortest_path": length,
        }

    # -- exact state -------------------------------------------------------------------------------------------

    def _records(self) -> dict[str, Any]:
        return {"walked": self.walked, "won": self.won, "level": self.level}

    def _recall(self, records: Mapping[str, Any]) -> None:
        self.walked, self.won, self.level = records["walked"], records["won"], records["level"]
        self.event, self.left_to_go = self.world.observe(), self.world.distance(self.episode.target)


def _schema(*, menu: bool) -> ActionSchema:
    actions = {name: ActionSpec(name, phrase, {}, f"{name}()") for name, (_, phrase, _) in CALLS.items()}
    aliases = {player.upper(): name for name, (player, _, _) in CALLS.items()} | {"DONE": "STOP", "END": "STOP"}
    return ActionSchema(actions, aliases, choices=tuple(c[1] for c in CALLS.values()) if menu else ())
