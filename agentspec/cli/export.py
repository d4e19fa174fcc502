"""`agentspec export`: a trained run as a folder that stands on its own."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from agentspec.cli.logs import INSPECT, export_logs


def add_parser(commands: Any) -> None:
    """Arguments of `agentspec export`."""
    parser = commands.add_parser(
        "export",
        help="write the trained adapter or merged weights, or logs for Inspect's viewer",
        description="Write a run's PEFT adapter, or the model with the adapter merged in, with a manifest; or "
        "(--to inspect) episodes as logs that Inspect's viewer opens.",
    )
    parser.add_argument(
        "run",
        metavar="RUN",
        help="folder of the run (its final model, else its last checkpoint); with --to inspect also an evaluation or a "
        "file of trajectories",
    )
    parser.add_argument(
        "--to", required=True, metavar="DIR|inspect", help="folder to write, new or empty; or `inspect`"
    )
    parser.add_argument("--out", metavar="DIR", help="with --to inspect: folder of the logs (default: inspect/ in RUN)")
    parser.add_argument("--pictures", action="store_true", help="with --to inspect: small pictures of every step")
    parser.add_argument("--merge", action="store_true", help="merge the adapter into the base model's weights")
    parser.add_argument("--json", action="store_true", help="print the manifest")
    parser.set_defaults(command=run)


def run(arguments: argparse.Namespace) -> int:
    """Export and say what was written."""
    if arguments.to == INSPECT:
        return export_logs(arguments)
    from trainers.export import MANIFEST, export

    folder = export(Path(arguments.run), Path(arguments.to), arguments.merge)
    manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    if arguments.json:
        print(json.dumps(manifest))
    else:
        print(f"{manifest['kind']} of {manifest['base_model']['name']} from {manifest['source']} -> {folder}")
    return 0
