"""``agentspec eval``: policies x scaffolds x tasks on paired seeds."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from eval.config import Matrix

HELD_OUT = "20000-20007"
BESIDE_CONFIG = (
    *("config", "executor", "workers", "address", "dry_run"),
    *("out", "store", "trajectories", "retry_failed", "plot", "json"),
)
"""Arguments that may stand beside `--config`; what all others say stands in the file."""


def add_parser(commands: Any) -> None:
    """Arguments of ``agentspec eval``."""
    parser = commands.add_parser(
        "eval",
        help="measure policies under scaffolds",
        description="Play every policy under every scaffold on the same tasks: intervals, paired tests.",
    )
    parser.add_argument("--config", metavar="FILE", help="the whole matrix as YAML: what is played, and how")
    parser.add_argument(
        "--policies",
        nargs="+",
        default=[],
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
        default=[HELD_OUT],
        metavar="SEEDS",
        help=f"task seeds such as 0-15 or 0,4,8 (default: {HELD_OUT}, held out from training)",
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
    group.add_argument(
        "--limit",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="episode_s, cell_s, cell_tokens or cell_dollars: what an episode or a cell may take; may be repeated",
    )
    group = parser.add_argument_group("where it runs")
    group.add_argument("--executor", choices=("local", "ray"), help="this process (default), or workers through Ray")
    group.add_argument(
        "--workers", type=at_least(1), metavar="N", help="Ray: processes with one model each (default: 1)"
    )
    group.add_argument("--address", metavar="URL", help="Ray: address of a cluster (default: this machine)")
    group.add_argument("--dry-run", action="store_true", help="print what would be played, and play nothing")
    group = parser.add_argument_group("output")
    group.add_argument("--out", metavar="DIR", help="folder of results; a stopped run goes on there")
    group.add_argument("--store", metavar="DIR", help="folder of finished episodes, may be shared (default: --out)")
    group.add_argument("--trajectories", action="store_true", help="keep every episode")
    group.add_argument("--retry-failed", action="store_true", help="play episodes again that failed")
    group.add_argument("--plot", action="store_true", help="write matrix.png")
    group.add_argument("--json", action="store_true", help="print the summary as JSON instead of tables")
    said = {name: value for name, value in vars(parser.parse_args([])).items() if name not in BESIDE_CONFIG}
    parser.set_defaults(command=run, out_resumes=True, said_by_config=said)


def run(arguments: argparse.Namespace) -> int:
    """Play what is left to play, write the report and print it.

    Exit code 1 if an episode could not be played or no episode could be scored.
    """
    from eval.live import LiveTable
    from eval.matrix import UNPLAYED, evaluate, kept_episodes
    from eval.tables import markdown, summarise, write_report

    require("scipy", *(["matplotlib"] if arguments.plot else []))  # for the report at the end
    matrix = _matrix(arguments)
    given = {name: getattr(arguments, name) for name in ("out", "store", "executor", "workers", "address")}
    call = dict(matrix.arguments) | {name: value for name, value in given.items() if value is not None}
    if not call.get("out"):
        raise SpecError("--out is missing: the folder of results (in a matrix file: `out`)")
    if arguments.dry_run:
        store = call.get("store") or call["out"]
        print(_summary(matrix, kept_episodes(matrix.policies, matrix.scaffolds, matrix.tasks, matrix.settings, store)))
        return 0
    rows = evaluate(
        matrix.policies, matrix.scaffolds, matrix.tasks, settings=matrix.settings, observer=LiveTable(), **call
    )
    write_report(rows, call["out"])
    if matrix.settings.trajectories and (bare := sum("key" in row and "trajectory" not in row for row in rows)):
        print(f"{bare} episodes were played before trajectories were kept, and have none", file=sys.stderr)
    if arguments.plot:
        from eval.plots import matrix_heatmap

        matrix_heatmap(summarise(rows), Path(call["out"]) / "matrix.png")
    if arguments.json:
        print(json.dumps([cell.to_data() for cell in summarise(rows)]))
    else:
        print(markdown(rows))
    statuses = {row["status"] for row in rows}
    return 0 if "completed" in statuses and UNPLAYED not in statuses else 1


def _matrix(arguments: argparse.Namespace) -> Matrix:
    """What to play, from `--config` or from the other arguments.

    Raises:
        SpecError: both, or neither.
    """
    from eval.config import Matrix, read_matrix

    if arguments.config:
        said = arguments.said_by_config
        given = [f"--{n.replace('_', '-')}" for n, default in said.items() if getattr(arguments, n) != default]
        if given:
            raise SpecError(f"{' and '.join(given)} beside --config: what is played, and how, stands in the file")
        matrix = read_matrix(arguments.config)
        changed: dict[str, Any] = {name: True for name in ("trajectories", "retry_failed") if getattr(arguments, name)}
        return replace(matrix, settings=replace(matrix.settings, **changed))
    if not arguments.policies:
        raise SpecError("nothing to evaluate: give --policies, or --config FILE")
    from agentspec.tasks import task_sets
    from eval.cells import Settings
    from eval.limits import Limits

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
        limits=Limits.from_data(key_values(arguments.limit, "--limit")),
    )
    options = environment_options(arguments)
    tasks = task_sets([Task(arguments.env, seed, options, "test") for seed in parse_seeds(arguments.seeds)])
    policies = tuple(parse_policy(text, arguments) for text in arguments.policies)
    return Matrix(policies, scaffolds(arguments.specs), tasks, settings)


def _summary(matrix: Matrix, kept: int) -> str:
    tasks = ", ".join(f"{label} ({len(members)})" for label, members in matrix.tasks.items())
    policies = ", ".join(f"{p.name} {p.run}".strip() for p in matrix.policies)
    return (
        f"policies: {policies}\nscaffolds: {', '.join(matrix.scaffolds)}\ntasks: {tasks}\n"
        f"{matrix.episodes} episodes, {kept} of them in the store"
    )


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
