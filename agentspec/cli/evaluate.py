"""``agentspec eval``: policies x scaffolds x tasks on paired seeds."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agentspec.cli.arguments import (
    add_environment,
    add_model,
    at_least,
    environment_options,
    key_values,
    labelled_spec,
    load_prices,
    parse_policy,
    parse_seeds,
)
from agentspec.cli.errors import require
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.types import Task


def add_parser(commands: Any) -> None:
    """Arguments of ``agentspec eval``."""
    parser = commands.add_parser(
        "eval",
        help="measure policies under scaffolds",
        description="Play every policy under every scaffold on the same tasks: intervals, paired tests.",
    )
    parser.add_argument(
        "--policies",
        nargs="+",
        required=True,
        metavar="[NAME=]MODEL[+ADAPTER]",
        help="rule-based, random, a model, or the folder of a trained adapter",
    )
    parser.add_argument(
        "--specs", nargs="+", default=[], metavar="[LABEL=]FILE|YAML", help="scaffolds (default: the plain one)"
    )
    add_environment(parser)
    add_model(parser)
    group = parser.add_argument_group("episodes")
    group.add_argument(
        "--seeds",
        nargs="+",
        default=["20000-20007"],
        metavar="SEEDS",
        help="task seeds such as 0-15 or 0,4,8 (default: %(default)s, held out from training)",
    )
    group.add_argument("--rollouts", type=at_least(1), default=1, metavar="N", help="episodes per task")
    group.add_argument("--seed", type=at_least(0), default=0, metavar="N", help="seed of the agents' own draws")
    group.add_argument("--concurrency", type=at_least(1), metavar="N", help="most episodes at once (default: all)")
    group.add_argument(
        "--start-memory",
        nargs="+",
        default=[],
        metavar="[POLICY=]FILE|DIR",
        help="memory that a run left, for scaffolds with scope: run; for all policies, or for those named",
    )
    group.add_argument(
        "--sampling", action="append", default=[], metavar="KEY=VALUE", help="sampling (default: temperature=0)"
    )
    group = parser.add_argument_group("output")
    group.add_argument("--out", required=True, metavar="DIR", help="folder of results; a stopped run goes on there")
    group.add_argument("--trajectories", action="store_true", help="keep every episode")
    group.add_argument("--retry-failed", action="store_true", help="play episodes again that failed")
    group.add_argument(
        "--replace-stale", action="store_true", help="play episodes again whose policy or scaffold has changed"
    )
    group.add_argument("--plot", action="store_true", help="write matrix.png")
    group.add_argument("--json", action="store_true", help="print the summary as JSON instead of tables")
    parser.set_defaults(command=run, out_resumes=True)


def run(arguments: argparse.Namespace) -> int:
    """Play what is left to play, write the report and print it; exit code 1 if no episode could be scored."""
    from eval.matrix import Settings, evaluate
    from eval.tables import markdown, summarise, write_report

    require("scipy", *(["matplotlib"] if arguments.plot else []))  # for the report at the end
    settings = Settings(
        rollouts=arguments.rollouts,
        seed=arguments.seed,
        sampling=key_values(arguments.sampling, "--sampling") or None,
        concurrency=arguments.concurrency,
        timeout_s=arguments.timeout,
        max_steps=arguments.max_steps,
        prices=load_prices(arguments.prices),
        trajectories=arguments.trajectories,
        start_memory=start_memory(arguments.start_memory),
        retry_failed=arguments.retry_failed,
        replace_stale=arguments.replace_stale,
    )
    options = environment_options(arguments)
    tasks = [Task(arguments.env, seed, options, "test") for seed in parse_seeds(arguments.seeds)]
    policies = [parse_policy(text, arguments) for text in arguments.policies]
    rows = evaluate(policies, scaffolds(arguments.specs), tasks, out=arguments.out, settings=settings, on_row=_report)
    write_report(rows, arguments.out)
    if arguments.plot:
        from eval.plots import matrix_heatmap

        matrix_heatmap(summarise(rows), Path(arguments.out) / "matrix.png")
    if arguments.json:
        print(json.dumps([cell.to_data() for cell in summarise(rows)]))
    else:
        print(markdown(rows))
    return 0 if any(row["status"] == "completed" for row in rows) else 1


def start_memory(texts: Sequence[str]) -> str | dict[str, str]:
    """One memory for all policies, or one each for those named.

    Raises:
        SpecError: several without a policy's name.
    """
    pairs = [text.partition("=") for text in texts]
    if len(texts) == 1 and (not pairs[0][1] or Path(texts[0]).exists()):
        return texts[0]
    if not all(equals for _, equals, _ in pairs):
        raise SpecError(f"--start-memory {' '.join(texts)}: with several, expected POLICY=FILE for each")
    return {policy: source for policy, _, source in pairs}


def scaffolds(texts: Sequence[str]) -> dict[str, AgentSpec]:
    """Specs by label; the plain one if none is given.

    Raises:
        SpecError: two specs with the same label.
    """
    if not texts:
        return {AgentSpec().label: AgentSpec()}
    found: dict[str, AgentSpec] = {}
    for label, spec in map(labelled_spec, texts):
        if label in found:
            raise SpecError(f"two scaffolds are labelled {label!r}; give each its own: LABEL=FILE")
        found[label] = spec
    return found


def _report(row: dict[str, Any]) -> None:
    """Progress and failures on stderr."""
    what = f"{row['policy']} / {row['scaffold']} / seed {row['seed']}"
    result = f"failed: {row['error']}" if row["status"] == "failed" else f"{row['steps']} steps"
    sys.stderr.write(f"{what}: {result}\n")
