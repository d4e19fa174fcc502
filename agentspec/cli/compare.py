"""`agentspec compare`: two episodes of one task side by side, as one page that opens from disk."""

from __future__ import annotations

import argparse
from typing import Any


def add_parser(commands: Any) -> None:
    """Arguments of `agentspec compare`."""
    parser = commands.add_parser(
        "compare",
        help="show two episodes of one task side by side",
        description="Write one HTML page with two episodes of one task: where they part, routes, gauges, every answer.",
    )
    for name in ("a", "b"):
        parser.add_argument(name, metavar="[NAME=]FILE[#N]", help="a file of trajectories, and which of them (from 0)")
    parser.add_argument("--to", default="compare.html", metavar="FILE", help="page to write (default: %(default)s)")
    parser.add_argument("--no-pictures", action="store_true", help="do not play the episodes again for pictures")
    parser.set_defaults(command=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the page and say where."""
    from eval.compare import write_comparison

    print(write_comparison(arguments.a, arguments.b, arguments.to, pictures=not arguments.no_pictures))
    return 0
