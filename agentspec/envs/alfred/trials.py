"""What is played: a trial is a scene, where everything starts, an instruction, and what is to be achieved.

Trials are read from ALFRED's `traj_data.json` files by path, or are our own (`own`). `PAPER` names the seven task
folders of valid_unseen whose wording is that of the AgentSpec paper, each with its three trials; which of the three the
paper plays is not stated, so the trial is a field and the one whose annotation matches comes first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agentspec.envs.thor.mining import read_json

TYPES = (
    "pick_and_place_simple",
    "pick_two_obj_and_place",
    "pick_heat_then_place_in_recep",
    "pick_cool_then_place_in_recep",
    "pick_clean_then_place_in_recep",
    "look_at_obj_in_light",
    "pick_and_place_with_movable_recep",
)
"""ALFRED's task types."""

PAPER: tuple[tuple[str, tuple[str, str, str]], ...] = (
    (
        "pick_and_place_simple-BaseballBat-None-Bed-308",
        ("trial_T20190906_185459_653538", "trial_T20190906_185515_986084", "trial_T20190906_185530_954329"),
    ),
    (
        "pick_two_obj_and_place-Pillow-None-Sofa-219",
        ("trial_T20190907_163240_345855", "trial_T20190907_163327_486300", "trial_T20190907_163408_914117"),
    ),
    (
        "pick_heat_then_place_in_recep-Apple-None-Fridge-10",
        ("trial_T20190906_182259_116320", "trial_T20190906_182353_418140", "trial_T20190906_182435_622538"),
    ),
    (
        "pick_cool_then_place_in_recep-Bread-None-CounterTop-10",
        ("trial_T20190908_091747_866951", "trial_T20190908_091811_414150", "trial_T20190908_091835_825830"),
    ),
    (
        "pick_clean_then_place_in_recep-Mug-None-CoffeeMachine-10",
        ("trial_T20190907_221208_560499", "trial_T20190907_221300_362511", "trial_T20190907_221355_558505"),
    ),
    (
        "look_at_obj_in_light-Pencil-None-DeskLamp-308",
        ("trial_T20190908_220545_153480", "trial_T20190908_220604_010430", "trial_T20190908_220656_510400"),
    ),
    (
        "pick_and_place_with_movable_recep-KeyChain-Box-ArmChair-219",
        ("trial_T20190909_042101_443154", "trial_T20190918_185132_685516", "trial_T20190918_192011_115694"),
    ),
)


@dataclass(frozen=True)
class Targets:
    """What a task is about, as object types; empty where the task type needs none."""

    object: str
    parent: str = ""
    movable: str = ""
    toggle: str = ""
    sliced: bool = False


@dataclass(frozen=True)
class Trial:
    """One thing to do.

    Args:
        id, type, scene: names; `type` is one of `TYPES`.
        instruction: what is to be achieved, in words.
        targets: what is to be achieved, for the goal conditions.
        poses, toggles: fields of `SetObjectPoses` and `SetObjectToggles`.
        start: the `TeleportFull` that puts the agent where it starts.
        dirty: whether everything starts dirty and empty.
        optimal: L*, the steps of the recorded expert; None: what our expert takes.
    """

    id: str
    type: str
    scene: str
    instruction: str
    targets: Targets
    poses: tuple[Mapping[str, Any], ...]
    start: Mapping[str, Any]
    toggles: tuple[Mapping[str, Any], ...] = ()
    dirty: bool = False
    optimal: int | None = None
    plan: tuple[Mapping[str, Any], ...] = field(default=(), repr=False)


def read_trial(path: Path, annotation: int = 0) -> Trial:
    """The trial of a `traj_data.json`; `annotation` picks one of its instructions.

    Raises:
        NoData: there is no such file.
        ValueError: the file is no trial, or has no such instruction.
    """
    data = read_json(path)
    try:
        scene, params = data["scene"], data["pddl_params"]
        words = data["turk_annotations"]["anns"]
        actions = tuple(step["api_action"] for step in data["plan"]["low_actions"])
        if not 0 <= annotation < len(words):
            raise ValueError(f"annotation is {annotation}; {path} has 0 to {len(words) - 1}")
        return Trial(
            id=data["task_id"],
            type=data["task_type"],
            scene=scene["floor_plan"],
            instruction=words[annotation]["task_desc"].strip(),
            targets=Targets(
                params["object_target"],
                params["parent_target"],
                params["mrecep_target"],
                params["toggle_target"],
                bool(params["object_sliced"]),
            ),
            poses=tuple(scene["object_poses"]),
            start=scene["init_action"],
            toggles=tuple(scene["object_toggles"]),
            dirty=bool(scene["dirty_and_empty"]),
            optimal=len(actions),
            plan=actions,
        )
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{path} is no ALFRED trial: {error!r}; expected a traj_data.json of version 2.1.0") from error


def trial_path(data: Path, task: int, trial: int) -> Path:
    """Where one of the paper's trials lies below `data` (the folder that has `valid_unseen`)."""
    folder, names = PAPER[task % len(PAPER)]
    return data / "valid_unseen" / folder / names[trial] / "traj_data.json"
