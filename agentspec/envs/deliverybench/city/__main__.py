"""Command line of the city generator.

    python -m agentspec.envs.deliverybench.city FOLDER [--size small] [--seed 0] [--count 1]

Each city becomes a folder SIZE-SEED with the two files of the benchmark's map format, which `load_city` (and ``--map``
of every command) reads.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from agentspec.envs.deliverybench.city.generate import PLANS, SPLITS, split_of, write_city


def main(argv: Sequence[str] | None = None) -> int:
    """Write cities and print one line each: the folder and the split of its seed."""
    ranges = ", ".join(f"{name} {seeds.start}-{seeds.stop - 1}" for name, seeds in SPLITS.items())
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description="Write generated cities in the benchmark's map format."
    )
    parser.add_argument("folder", help="where each city gets a folder SIZE-SEED")
    parser.add_argument("--size", choices=list(PLANS), default="small")
    parser.add_argument("--seed", type=int, default=0, help=f"first city seed ({ranges})")
    parser.add_argument("--count", type=int, default=1, help="how many cities, of consecutive seeds")
    arguments = parser.parse_args(argv)
    seeds = range(arguments.seed, arguments.seed + arguments.count)
    try:
        splits = [split_of(seed) for seed in seeds]
    except ValueError as error:
        parser.error(str(error))
    for seed, split in zip(seeds, splits, strict=True):
        folder = write_city(Path(arguments.folder) / f"{arguments.size}-{seed}", arguments.size, seed)
        print(f"{folder} ({split})")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
