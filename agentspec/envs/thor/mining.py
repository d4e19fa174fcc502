"""Scenes from public data: recorded object metadata, layouts of reachable cells, trials and episodes.

A scene is mined once, from everything that is known of it, and is the same for all its tasks:

- boxes and abilities from recorded object metadata (`<scene>.json` or `.json.gz`, a list of objects with `aabb`);
- cells from the layout (`<scene>-layout.npy`), from where trials start and walk, and from episodes' shortest paths;
- ids of furniture from the layout's receptacles (`<scene>-openable.json`) and from all trials, because builds of the
  simulator shifted furniture a little: the id of an object of the same type less than 0.7 m away is an alias of it,
  furniture that the metadata lack is added with its type's usual size;
- sight cells of the target types from the ends of the episodes' shortest paths, which stop where the target is seen.

`leave_out` mines without the plan of one trial, to measure what it contributes.
"""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from agentspec.envs.thor.kinds import kind
from agentspec.envs.thor.scene import GRID, Cell, Scene, Thing, cell_at

NEAR = 0.7
"""Metres within which an id of the same type names the same piece of furniture in another build."""

_TURN = {"RotateLeft": -90, "RotateRight": 90}


class NoData(FileNotFoundError):  # noqa: N818  (reads as a sentence)
    """A file of public data that is not where it was looked for."""


def read_json(path: Path) -> Any:
    """A JSON file, gzipped or not.

    Raises:
        NoData: it is not there.
        ValueError: it is no JSON.
    """
    if not path.is_file():
        raise NoData(f"there is no file {path}; give the folder that holds the public data")
    if path.suffix == ".gz":
        with gzip.open(path, "rt", encoding="utf-8") as file:
            return json.load(file)
    return json.loads(path.read_text(encoding="utf-8"))


def things_of(records: Iterable[Mapping[str, Any]]) -> list[Thing]:
    """Recorded objects as things of a scene."""
    able = ("pickupable", "openable", "receptacle", "toggleable", "sliceable", "moveable")
    made = []
    for r in records:
        box = r["aabb"]
        made.append(
            Thing(
                r["objectId"],
                r["objectType"],
                tuple(box["center"][k] for k in "xyz"),
                tuple(max(box["size"][k], 0.01) for k in "xyz"),
                tuple(r["position"][k] for k in "xyz"),
                str(r.get("name", "")),
                float(r["rotation"]["y"]) % 360.0,
                frozenset(a for a in able if r.get(a)),
                open=bool(r.get("isOpen")),
                on=bool(r.get("isToggled")),
            )
        )
    return made


def objects_file(folder: Path, scene: str) -> Path:
    """Where a scene's recorded objects are: `<scene>.json` or `<scene>.json.gz`."""
    plain = folder / f"{scene}.json"
    return plain if plain.is_file() else folder / f"{scene}.json.gz"


# -- ALFRED ------------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=256)
def household(scene: str, trials: str, objects: str, layouts: str, leave_out: str = "") -> Scene:
    """The scene of ALFRED trials.

    Args:
        scene: `FloorPlan10`, say.
        trials: folder with `*-<number>/<trial>/traj_data.json` below it; all trials of the scene are read.
        objects: folder with recorded object metadata.
        layouts: folder with layouts.
        leave_out: a trial whose plan is not read.

    Raises:
        NoData: a file is not there.
    """
    things = things_of(read_json(objects_file(Path(objects), scene)))
    layout = Path(layouts) / f"{scene}-layout.npy"
    if not layout.is_file():
        raise NoData(f"there is no layout {layout}; give the folder that holds the layouts")
    cells = {cell_at(float(x), float(z)) for x, z in np.load(layout, allow_pickle=False)}
    receptacles = Path(layouts) / f"{scene}-openable.json"
    ids = set(read_json(receptacles)) if receptacles.is_file() else set()
    number = scene.removeprefix("FloorPlan")
    for path in sorted(Path(trials).glob(f"**/*-{number}/*/traj_data.json")):
        trial = read_json(path)
        if trial["scene"]["floor_plan"] != scene:
            continue
        start = trial["scene"]["init_action"]
        cells.add(cell_at(start["x"], start["z"]))
        if trial["task_id"] == leave_out:
            continue
        cells |= _walked(trial)
        ids |= _furniture(trial)
    fixed, aliases = _aliases(things, ids)
    # containers start closed; what is in them is placed by the trial
    shut = tuple(replace(t, open=False) if {"openable", "receptacle"} <= t.abilities else t for t in fixed)
    return Scene(scene, frozenset(cells), shut, aliases=aliases)


def _walked(trial: Mapping[str, Any]) -> set[Cell]:
    """The cells a recorded trial walks over."""
    start = trial["scene"]["init_action"]
    x, z = cell_at(start["x"], start["z"])
    yaw = int(start["rotation"])
    cells = {(x, z)}
    for step in trial["plan"]["low_actions"]:
        name = step["api_action"]["action"]
        yaw += _TURN.get(name, 0)
        if name == "MoveAhead":
            x += round(math.sin(math.radians(yaw)))
            z += round(math.cos(math.radians(yaw)))
            cells.add((x, z))
    return cells


def _furniture(trial: Mapping[str, Any]) -> set[str]:
    """The ids of furniture that a trial's plan names: what is not among the objects that the trial places."""
    ids = set()
    for step in trial["plan"]["low_actions"]:
        action = step["api_action"]
        ids |= {action[k] for k in ("objectId", "receptacleObjectId") if action.get(k)}
    return {i for i in ids if "pickupable" not in kind(i.split("|")[0]).abilities or i.startswith("Laptop")}


def _aliases(things: list[Thing], ids: set[str]) -> tuple[list[Thing], dict[str, str]]:
    """Names of the older build for the things, and the things that only the older build has."""
    known = {t.id: t for t in things}
    aliases: dict[str, str] = {}
    added: list[Thing] = []
    for name in sorted(ids - set(known)):
        parts = name.split("|")
        type_name = parts[-1] if parts[-1].isalpha() else parts[0]
        place = tuple(float(p) for p in parts[1:4])
        same = [t for t in things if t.type == type_name and t.id not in aliases.values()]
        near = min(same, key=lambda t: math.dist(t.position, place), default=None)
        if near is not None and math.dist(near.position, place) < NEAR:
            aliases[name] = near.id
        elif type_name in ADDABLE:
            size = kind(type_name).size
            centre = (place[0], place[1] + size[1] / 2, place[2])
            added.append(Thing(name, type_name, centre, size, place, name, 0.0, kind(type_name).abilities))  # type: ignore[arg-type]
    # the names of the recorded plans are the ones to use
    renamed = {new: old for old, new in aliases.items()}
    fixed = [replace(t, id=renamed.get(t.id, t.id)) for t in things]
    return [*fixed, *added], {new: old for new, old in renamed.items()}


ADDABLE = frozenset(
    {"DeskLamp", "Faucet", "CoffeeMachine", "FloorLamp", "Laptop", "Television", "Safe", "LaundryHamper"}
)
"""Furniture that one build has and another lacks, and that plans use."""


# -- RoboTHOR ----------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=256)
def apartment(scene: str, episodes: str, objects: str) -> Scene:
    """The scene of RoboTHOR episodes.

    Args:
        scene: `FloorPlan_Val1_1`, say.
        episodes: folder with `<scene>.json.gz`: all episodes of the scene are read.
        objects: folder with recorded object metadata.

    Raises:
        NoData: a file is not there.
    """
    things = things_of(read_json(objects_file(Path(objects), scene)))
    cells: set[Cell] = set()
    sights: dict[str, set[Cell]] = {}
    for episode in read_json(objects_file(Path(episodes), scene)):
        start, path = episode["initial_position"], episode["shortest_path"]
        cells.add(cell_at(start["x"], start["z"]))
        cells |= path_cells(path)
        if path:
            sights.setdefault(episode["object_type"], set()).add(cell_at(path[-1]["x"], path[-1]["z"]))
    return Scene(scene, frozenset(cells), tuple(things), sights={k: frozenset(v) for k, v in sights.items()})


def path_cells(path: Iterable[Mapping[str, float]]) -> set[Cell]:
    """The cells under a polyline of positions (looked at every 5 cm)."""
    points = [(p["x"], p["z"]) for p in path]
    cells = set()
    for (ax, az), (bx, bz) in pairwise(points):
        n = max(1, int(math.hypot(bx - ax, bz - az) / (GRID / 5)))
        cells |= {cell_at(ax + (bx - ax) * i / n, az + (bz - az) * i / n) for i in range(n + 1)}
    return cells
