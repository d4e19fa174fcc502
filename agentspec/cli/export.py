"""`agentspec export`: a trained run as a folder that stands on its own."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any


def add_parser(commands: Any) -> None:
    """Arguments of `agentspec export`."""
    parser = commands.add_parser(
        "export",
        help="write the trained adapter or merged weights",
        description="Write a run's PEFT adapter, or the model with the adapter merged in, with a manifest.",
    )
    parser.add_argument("run", metavar="RUN", help="folder of the run (its final model, else its last checkpoint)")
    parser.add_argument("--to", required=True, metavar="DIR", help="folder to write; must not exist or be empty")
    parser.add_argument("--merge", action="store_true", help="merge the adapter into the base model's weights")
    parser.add_argument("--json", action="store_true", help="print the manifest")
    parser.set_defaults(command=run)


def run(arguments: argparse.Namespace) -> int:
    """Export and say what was written."""
    from trainers.export import MANIFEST, export

    folder = export(Path(arguments.run), Path(arguments.to), arguments.merge)
    manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    if arguments.json:
        print(json.dumps(manifest))
    else:
        print(f"{manifest['kind']} of {manifest['base_model']['name']} from {manifest['source']} -> {folder}")
    return 0
