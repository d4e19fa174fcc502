"""Recorded ALFRED experts, replayed: how many trials reach their goal in the offline player, or through ai2thor.

    python -m benchmarks.alfred_replays --data DIR [--tables DIR] [--objects DIR] [--layouts DIR]
        [--without-own-plan] [--standin] [--json]

`--data` is searched for `traj_data.json` of scenes whose object metadata and layout are there. A scene's table (cells,
names of furniture) is mined from the trials below `--tables`, by default the same. `--without-own-plan` mines a table
for each trial that does not know its plan (minutes). `--standin` plays through ai2thor 2.1.0's Controller and the
stand-in.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

from agentspec.envs.alfred.goals import Changes, Progress, progress
from agentspec.envs.alfred.staging import SETTINGS, set_up
from agentspec.envs.alfred.trials import Trial, read_trial
from agentspec.envs.thor.engine import OfflineThor
from agentspec.envs.thor.mining import household, objects_file
from agentspec.envs.thor.protocol import Thor

HOUSEHOLD = Path(__file__).resolve().parents[2] / "shared" / "household"


def replay(world: Thor, trial: Trial) -> tuple[Progress, int]:
    """Goal conditions after the recorded plan, and how many of its actions failed."""
    set_up(world, trial)
    changes, failed, event = Changes(), 0, world.observe()
    for action in trial.plan:
        event = world.step(action)
        changes.follow(event.metadata, str(action.get("objectId", "")))
        failed += not event.success
    return progress(trial.type, trial.targets, event.metadata, changes), failed


def main() -> None:
    """Replay and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--data", type=Path, default=HOUSEHOLD / "alfred_json_2.1.0")
    parser.add_argument("--tables", type=Path, default=None)
    parser.add_argument("--objects", type=Path, default=HOUSEHOLD / "objects")
    parser.add_argument("--layouts", type=Path, default=HOUSEHOLD / "layouts")
    parser.add_argument("--without-own-plan", action="store_true")
    parser.add_argument("--standin", action="store_true")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    folders = {"trials": str(given.tables or given.data), "objects": str(given.objects), "layouts": str(given.layouts)}
    remote: Any = None
    if given.standin:
        from agentspec.envs.thor.simulator.player import Ai2Thor

        remote = Ai2Thor("2.1.0", SETTINGS, executable="standin", pictures=False, folders=folders)
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0, 0, 0])
    misses = []
    for path in sorted(given.data.glob("**/traj_data.json")):
        trial = read_trial(path)
        if not objects_file(given.objects, trial.scene).is_file():
            continue
        if remote is not None:
            remote.begin(trial.scene)
        unknown = trial.id if given.without_own_plan else ""
        world: Thor = remote or OfflineThor(household(trial.scene, *folders.values(), leave_out=unknown), SETTINGS)
        reached, failed = replay(world, trial)
        row = counts[trial.type + (", sliced" if trial.targets.sliced else "")]
        for k, value in enumerate((1, reached.success, reached.met, reached.total, failed == 0)):
            row[k] += int(value)
        if failed or not reached.success:
            misses.append(f"{path.parent.parent.name}/{trial.id}: {reached.met}/{reached.total}, {failed} failed")
    if remote is not None:
        remote.close()
    total = [sum(column) for column in zip(*counts.values(), strict=True)]
    names = ("trials", "succeed", "conditions_met", "conditions", "without_failed_action")
    result = {k: dict(zip(names, v, strict=True)) for k, v in [*sorted(counts.items()), ("all", total)]}
    if given.json:
        print(json.dumps({"types": result, "misses": misses}, indent=2))
        return
    for kind, row in result.items():
        print(kind, " ".join(f"{k}={v}" for k, v in row.items()))
    print(*misses, sep="\n")


if __name__ == "__main__":
    main()
