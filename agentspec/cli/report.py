"""`agentspec report`: an account of an evaluation as HTML, Markdown, LaTeX, CSV and Parquet."""

from __future__ import annotations

import argparse
from typing import Any

from agentspec.registry import SpecError


def add_parser(commands: Any) -> None:
    """Arguments of `agentspec report`."""
    parser = commands.add_parser(
        "report",
        help="write a report of an evaluation",
        description="Tables and figures of an evaluation: one HTML page, Markdown, LaTeX, CSV and Parquet.",
    )
    parser.add_argument("results", metavar="DIR", help="folder of an evaluation, or its results.jsonl")
    parser.add_argument("--to", required=True, metavar="DIR", help="folder to write into")
    parser.add_argument("--title", default="", help="heading of the report")
    parser.add_argument(
        "--runs", nargs="+", default=[], metavar="RECIPE=DIR,...", help="training runs, for learning curves"
    )
    parser.add_argument(
        "--publish", choices=("wandb", "tensorboard"), help="log tables, figures and the report there as well"
    )
    parser.add_argument("--project", default="agentspec", help="with --publish wandb (default: %(default)s)")
    parser.add_argument("--paper", action="store_true", help="set the paper's numbers beside ours")
    parser.set_defaults(command=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the report and say where."""
    from eval.report import build_report, write_files

    try:
        report = build_report(
            arguments.results, title=arguments.title, runs=_runs(arguments.runs), paper=arguments.paper
        )
    except ValueError as error:
        raise SpecError(str(error)) from error
    for path in write_files(report, arguments.to):
        print(path)
    if arguments.publish:
        from eval.report.publish import publish

        print(publish(report, arguments.to, arguments.publish, project=arguments.project))
    return 0


def _runs(texts: list[str]) -> dict[str, list[str]]:
    found = {}
    for text in texts:
        recipe, equals, folders = text.partition("=")
        if not equals or not folders:
            raise SpecError(f"--runs {text!r}: expected RECIPE=FOLDER, or RECIPE=FOLDER,FOLDER for several runs")
        found[recipe] = folders.split(",")
    return found
