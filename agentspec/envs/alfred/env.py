"""ALFRED for language agents: an instruction, the objects within 1.5 m, named actions, 200 primitive steps.

What is in view is listed by name; actions are ALFRED's own low-level ones (`native`), or a `menu` of what makes sense
now (go to, take, put, open, ...), of which `go to` takes as many primitive steps as the way has.

Metrics, kept apart: `success` (all goal conditions at once), `goal_conditions` (their share met), `spl` = success *
min(1, L*/steps), `goal_spl` = share * min(1, L*/steps), with L* the recorded expert's steps (our tasks: our expert's)
and steps primitive ones. The return is the share of goal conditions, paid as it changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Literal

from agentspec.envs.alfred import menu
from agentspec.envs.alfred.goals import Changes, Progress, progress
from agentspec.envs.alfred.listing import in_view, worded
from agentspec.envs.alfred.own import TASKS, own_trial
from agentspec.envs.alfred.staging import SETTINGS, set_up
from agentspec.envs.alfred.trials import PAPER, Trial, read_trial, trial_path
from agentspec.envs.shared import check
from agentspec.envs.thor.game import Game, Told, check_folders, check_index
from agentspec.envs.thor.homes import room
from agentspec.envs.thor.mining import household
from agentspec.envs.thor.names import Names
from agentspec.envs.thor.protocol import Event
from agentspec.envs.thor.scene import Scene, cell_at
from agentspec.envs.thor.ways import way_to_see
from agentspec.metrics import Metric
from agentspec.types import Action, ActionSchema

RULES = """You act in a room of a house, one action at a time. Only objects within 1.5 m that the camera shows can be \
used; you see them listed. Moves are 0.25 m, turns 90 degrees, the camera looks up or down by 15 degrees.
- You can hold one object. Closed containers hide what is in them; open them first.
- Heat: put it into the microwave, close it, turn it on. Cool: put it into the fridge and close it. Clean: put it into \
the sink basin and turn the faucet on. Slice: hold a knife. Look at it in the light: hold it and turn the lamp on, \
with the lamp in view.
- You have {steps} steps; fewer steps are better. {stop}
Your task: {task}"""


class AlfredEnv(Game):
    """One room, one task.

    Args:
        suite: `own` (our tasks; the seed picks one and its layout) or `paper` (the seven tasks, seed modulo seven;
            needs `data`).
        task: index of a suite's task (0 to 15 of `own`, 0 to 6 of `paper`) instead of the seed's; -1 for the seed's.
        trial: which of the three trials of a task of the paper (0 to 2).
        trial_file: path of any `traj_data.json`, instead of a suite.
        data: folder with ALFRED's json files (that has `valid_unseen`, or the trials in other folders below it).
        objects, layouts: folders with recorded object metadata and layouts; default: beside `data`.
        annotation: which of the instructions people wrote, from 0.
        action_mode: `native` calls, or a `menu`.
        max_steps: primitive steps after which the episode is truncated.
        end_on_success: end when all goal conditions are met; else only `STOP()` ends.
        images: put the egocentric picture into the observation, uint8 (300, 300, 3).
        render_mode: None or "rgb_array".
        player: `offline`, or `ai2thor`: the simulator, version 2.1.0.
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
            Metric("success", summary="whether all goal conditions are met at once (0 or 1)"),
            Metric("goal_conditions", summary="share of the goal conditions that are met, k/n"),
            Metric("spl", heading="SPL", summary="success * min(1, L*/steps), L* the expert's steps"),
            Metric("goal_spl", heading="goal SPL", summary="share of goal conditions * min(1, L*/steps)"),
            Metric("primitive_steps", digits=1, higher_is_better=False, summary="steps, those of `go to` one by one"),
        ),
        "typical_return": 1.0,
    }
    failure_signs: ClassVar[str] = "agentspec.envs.thor.signs:alfred"
    experts: ClassVar[dict[str, str]] = {
        "rule_based": "agentspec.envs.alfred.expert:expert",
        "random": "agentspec.envs.alfred.expert:luck",
    }

    @staticmethod
    def episode_key(options: Mapping[str, Any], seed: int) -> tuple[str, int, int]:
        """Name of the episode that a seed starts: the file, or suite, task and trial (of ours every seed is one)."""
        if options.get("trial_file"):
            return str(Path(options["trial_file"]).resolve()), 0, 0
        suite, number = options.get("suite", "own"), options.get("task", -1)
        number = seed if number < 0 else number
        return suite, number if suite == "own" else number % len(PAPER), options.get("trial", 0)

    def __init__(
        self,
        *,
        suite: Literal["own", "paper"] = "own",
        task: int = -1,
        trial: int = 0,
        trial_file: str = "",
        data: str = "",
        objects: str = "",
        layouts: str = "",
        annotation: int = 0,
        action_mode: Literal["native", "menu"] = "native",
        max_steps: int = 200,
        end_on_success: bool = True,
        images: bool = False,
        render_mode: str | None = None,
        player: Literal["offline", "ai2thor"] = "offline",
        executable: str = "",
    ) -> None:
        check("suite", suite, ("own", "paper"))
        check("action_mode", action_mode, ("native", "menu"))
        recorded = suite == "paper" or bool(trial_file)
        if recorded and not data:
            raise ValueError("data is empty; give the folder with ALFRED's json files (that has valid_unseen)")
        tasks = 1 if trial_file else len(PAPER if recorded else TASKS)
        check_index("task", task, -1, tasks - 1 if tasks > 1 else -1)
        check_index("trial", trial, 0, len(PAPER[0][1]) - 1 if recorded and not trial_file else 0)
        check_index("annotation", annotation, 0, None if recorded else 0)
        check_folders(recorded, data=data, objects=objects, layouts=layouts)
        self._objects = objects or str(Path(data).parent / "objects")
        self._layouts = layouts or str(Path(data).parent / "layouts")
        super().__init__(
            max_steps=max_steps,
            images=images,
            settings=SETTINGS,
            render_mode=render_mode,
            player=player,
            version="2.1.0",
            executable=executable,
            folders={"trials": data, "objects": self._objects, "layouts": self._layouts} if data else {},
        )
        self._suite, self._task, self._trial_number, self._file = suite, task, trial, trial_file
        self._data, self._annotation = data, annotation
        self._menu, self._end_on_success = action_mode == "menu", end_on_success

    # -- the episode -------------------------------------------------------------------------------------------

    def trial_of(self, seed: int) -> Trial:
        """The trial that a seed starts."""
        if self._file:
            return read_trial(Path(self._file), self._annotation)
        number = seed if self._task < 0 else self._task
        if self._suite == "own":
            return own_trial(number)
        return read_trial(trial_path(Path(self._data), number % len(PAPER), self._trial_number), self._annotation)

    def _scene(self, trial: Trial) -> Scene:
        if trial.id.startswith("own_"):
            return room(trial.scene)
        scene = household(trial.scene, self._data, self._objects, self._layouts)
        start = cell_at(trial.start["x"], trial.start["z"])
        # a trial that is not among those the scene was mined from starts where it says
        return scene if start in scene.cells else replace(scene, cells=scene.cells | {start})

    def _begin(self, seed: int) -> None:
        self.trial = self.trial_of(seed)
        self.world = self._open(self.trial.scene, lambda: self._scene(self.trial))
        set_up(self.world, self.trial)
        self.changes, self.names, self.known = Changes(), Names(), set[str]()
        self._ways: dict[tuple[Any, ...], bool] = {}
        self._look(self.world.observe())

    def act(self, action: Mapping[str, Any]) -> Event:
        """One primitive: it counts, and may clean, heat or cool."""
        event = super().act(action)
        self.changes.follow(event.metadata, str(action.get("objectId", "")))
        self._look(event)
        return event

    def _look(self, event: Event) -> None:
        """Name what is new, know what has been seen, and see how the task stands."""
        self.event = event
        self.names.add(event.metadata["objects"])
        for one in event.metadata["objects"]:
            if one["visible"]:
                self.known.add(one["objectId"])
                if not one["openable"] or one["isOpen"]:
                    self.known.update(one["receptacleObjectIds"] or ())
        self.progress: Progress = progress(self.trial.type, self.trial.targets, event.metadata, self.changes)

    def reachable(self, one: Mapping[str, Any]) -> bool:
        """Whether there is a way to see an object; found once for where it is and what is around it."""
        at, inside = one["position"], tuple(one["parentReceptacles"] or ())
        boxes = self.world.boxes()
        hidden = any(b.closed or b.held for b in boxes.state.bodies.values() if b.id in inside)
        key = (one["objectId"], at["x"], at["y"], at["z"], inside, hidden)
        if key not in self._ways:
            self._ways[key] = way_to_see(boxes, boxes.state.bodies[one["objectId"]]) is not None
        return self._ways[key]

    def _over(self) -> bool:
        return self.stopped or (self._end_on_success and self.progress.success)

    def _schema(self) -> ActionSchema:
        if not self._menu:
            return menu.NATIVE
        return replace(menu.NATIVE, choices=menu.choices(self))

    def _carry_out(self, action: Action) -> None:
        self.told = Told(*menu.carry_out(self, action))

    def _value(self) -> float:
        return self.progress.share

    # -- reporting ---------------------------------------------------------------------------------------------

    def _describe(self) -> dict[str, Any]:
        listed = in_view(self.event.metadata, self.names)
        held = self.event.metadata["inventoryObjects"]
        holding = self.names.name(held[0]["objectId"]) if held else ""
        agent = self.event.metadata["agent"]
        lines = [
            f"Step {self.steps} of {self.max_steps}. You hold {holding or 'nothing'}. The camera looks "
            f"{agent['cameraHorizon']:g} deg down.",
            "In view within 1.5 m: " + ("; ".join(map(worded, listed)) or "nothing") + ".",
        ]
        if self.told.message or self.told.error:
            lines.insert(0, f"Last: {self.told.message or self.told.error}.")
        if self._schema_now.choices:
            lines.append("You can: " + "; ".join(self._schema_now.choices))
        stop = "It ends when the task is done." if self._end_on_success else ""
        rules = RULES.format(
            steps=self.max_steps, stop=stop or "Say STOP() when it is done.", task=self.trial.instruction
        )
        return {
            "instruction": rules,
            "text": "\n".join(lines),
            "state": {
                "task": self.trial.instruction,
                "trial": self.trial.id,
                "seed": self.episode_seed,
                "holding": holding,
                "visible": listed,
                "facing": agent["rotation"]["y"],
                "horizon": agent["cameraHorizon"],
                "steps_left": self.left,
                "history": list(self.history),
            },
            "success": self.progress.success,
            "metrics": self._metrics(),
            "goal_conditions": self.progress.share,
        }

    def _metrics(self) -> dict[str, Any]:
        now = self.progress
        found: dict[str, Any] = {
            "success": float(now.success),
            "goal_conditions": now.share,
            "goal_conditions_met": now.met,
            "goal_conditions_total": now.total,
            "primitive_steps": self.steps,
            "spl": None,
            "goal_spl": None,
        }
        if self._over() or self.truncated:
            best = self.trial.optimal or _expert_steps(self.trial)
            factor = min(1.0, best / max(self.steps, 1))
            found |= {"spl": float(now.success) * factor, "goal_spl": now.share * factor, "optimal_steps": best}
        return found

    # -- exact state -------------------------------------------------------------------------------------------

    def _records(self) -> dict[str, Any]:
        return {"changes": self.changes.data(), "names": self.names.data(), "known": sorted(self.known)}

    def _recall(self, records: Mapping[str, Any]) -> None:
        self.changes = Changes(**{k: set(v) for k, v in records["changes"].items()})
        self.names, self.known = Names(records["names"]), set(records["known"])
        self._look(self.world.observe())


@lru_cache(maxsize=1024)
def _own_expert_steps(seed: int) -> int:
    from agentspec.envs.alfred.expert import expert_steps

    return expert_steps(seed)


def _expert_steps(trial: Trial) -> int:
    return _own_expert_steps(int(trial.id.removeprefix("own_")))
