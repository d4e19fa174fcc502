"""``agentspec audit``: a training run's updates, checked against its episodes."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from typing import Any

from agentspec.cli.arguments import at_least


def add_parser(commands: Any) -> None:
    """Arguments of ``agentspec audit``."""
    parser = commands.add_parser(
        "audit",
        help="verify every update of a training run",
        description=(
            "Check that no record of the run was edited, then make the receipt of every update anew from its episodes: "
            "tokens, log-probabilities, constraints, masks, advantages, denominators. Exit code 0 if all agrees, 1 if "
            "anything does not, 3 if all agrees so far and the run has not ended (or was interrupted): nothing after "
            "its last receipt is covered."
        ),
    )
    parser.add_argument("run", metavar="RUN", help="folder of the run (its output_dir)")
    parser.add_argument("--step", type=at_least(0), metavar="N", help="only the update of this step (default: all)")
    parser.add_argument(
        "--head", default="", metavar="DIGEST", help="head of the chain, as the run printed it when it ended"
    )
    parser.add_argument("--json", action="store_true", help="print the receipts as JSON, one line each")
    parser.set_defaults(command=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the receipts; exit code 1 on a violation, else 3 if the run has not ended."""
    from trainers.audit import audit

    updates, violations, notes = 0, 0, list[str]()
    for receipt in audit(arguments.run, arguments.step, head=arguments.head):
        updates += receipt.round is not None
        violations += len(receipt.violations)
        notes += receipt.notes
        if arguments.json:
            print(json.dumps(asdict(receipt), sort_keys=True))
        else:
            print("\n".join(receipt.lines()))
    if not arguments.json:
        verdict = "no violation" if not violations else f"{violations} violation{'s' * (violations > 1)}"
        print("; ".join([f"{updates} update{'s' * (updates != 1)} audited: {verdict}", *notes]))
    return 1 if violations else 3 if notes else 0
