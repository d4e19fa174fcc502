"""``agentspec run``: play episodes and say what came of them."""

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
    load_prices,
    parse_policy,
)
from agentspec.progress import episode_progress, load_policy
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory, write_trajectories
from agentspec.types import Task, Transition

if TYPE_CHECKING:
    from agentspec.policies import Policy

UNTOLD = ("input_tokens_per_step", "output_tokens_per_step", "calls_per_step", "cost")
"""Figures that the line about a finished episode leaves out."""


def add_parser(commands: Any) -> None:
    """Arguments of ``agentspec run``."""
    parser = commands.add_parser("run", help="play episodes", description="Play episodes of one agent.")
    add_environment(parser)
    group = parser.add_argument_group("agent")
    group.add_argument("--spec", metavar="FILE|YAML", help="agent spec: a YAML file, or YAML text")
    group.add_argument(
        "--policy",
        "--model",
        default="",
        metavar="NAME",
        help="rule-based, random, or a model: a folder, bundled name or hub id",
    )
    group.add_argument("--adapter", default="", metavar="DIR", help="PEFT adapter on top of the model")
    group.add_argument(
        "--sampling", action="append", default=[], metavar="KEY=VALUE", help="sampling, e.g. temperature=0"
    )
    add_model(parser)
    group = parser.add_argument_group("episodes")
    group.add_argument("--seed", type=at_least(0), default=0, metavar="N", help="of the first task (default: 0)")
    group.add_argument("--episodes", type=at_least(1), default=1, metavar="N", help="tasks with consecutive seeds")
    group.add_argument("--concurrency", type=at_least(1), metavar="N", help="most episodes at once (default: all)")
    group.add_argument(
        "--start-memory", default="", metavar="FILE|DIR", help="start from a memory that a run left (scope: run)"
    )
    group = parser.add_argument_group("output")
    group.add_argument(
        "--out",
        metavar="FILE",
        help="write the trajectories, one JSON line each; with `scope: run` the memory beside it",
    )
    group.add_argument("--gif", metavar="FILE", help="write an animation of the first episode")
    group.add_argument("--json", action="store_true", help="print JSON; the last line has the (mean) outcome")
    parser.set_defaults(command=run)


def run(arguments: argparse.Namespace) -> int:
    """Play, print, write; exit code 1 if an episode failed."""
    from agentspec.carry import run_in_order, save_bank, start_bank
    from agentspec.cli.frames import Film
    from agentspec.episode import Job, Runner, environment_id, make_env
    from agentspec.policies import check_agent

    environment_id(arguments.env)  # a mistyped name is told before anything else
    policy, spec = agent(arguments)
    options = environment_options(arguments)
    tasks = [Task(arguments.env, arguments.seed + i, options, "test") for i in range(arguments.episodes)]
    # The environment is made once more in its worker; here, an unknown name or a missing map is still a plain error.
    env = make_env(tasks[0])
    check_agent(policy, spec, env, arguments.env)
    env.close()
    start = start_bank(arguments.start_memory, spec)
    film = Film(arguments.gif, tasks[0]) if arguments.gif else None
    prices = load_prices(arguments.prices)
    runner = Runner(
        spec,
        load_policy(policy) if policy else None,
        make_env=film.make_env if film else make_env,
        concurrency=arguments.concurrency,
        timeout_s=arguments.timeout,
        max_steps=arguments.max_steps,
        prices=prices,
        policy=policy.name if policy else spec.reasoning.name,
        on_done=None if arguments.json else _print_outcome,
        on_step=_print_step if policy and not policy.scripted else None,
        progress=episode_progress,
    )
    jobs = [Job(task) for task in tasks]
    if spec.scope == "run":
        trajectories, bank = run_in_order(runner, jobs, start)
        if arguments.out:
            save_bank(Path(arguments.out).with_suffix(".memory.json"), bank)
    else:
        trajectories = runner.run(jobs)
    if arguments.out:
        write_trajectories(arguments.out, trajectories)
    failed = [t for t in trajectories if not t.scorable]
    if film and not (failed and failed[0] is trajectories[0]):
        film.save()
    for trajectory in failed:
        sys.stderr.write(f"agentspec: episode with seed {trajectory.task.seed} failed: {trajectory.error}\n")
    if arguments.json:
        _print_json(trajectories)
    return 1 if failed else 0


def agent(arguments: argparse.Namespace) -> tuple[Policy | None, AgentSpec]:
    """The policy (``None`` if the spec needs no model and none was named) and the spec it plays.

    Raises:
        SpecError: the spec calls a model and none was named.
    """
    from agentspec.policies import needs_model

    spec = AgentSpec.from_yaml(arguments.spec) if arguments.spec else AgentSpec()
    if arguments.sampling:
        sampling = {**vars(spec.sampling), **key_values(arguments.sampling, "--sampling")}
        spec = replace(spec, sampling=AgentSpec.from_data({"sampling": sampling}).sampling)
    if not arguments.policy:
        if needs_model(spec):
            raise SpecError(
                f"the agent ({spec.label}) calls a model and none was named; give --policy a model (a folder, hub id "
                "or smollm2-135m), or one that needs none: rule-based, random"
            )
        return None, spec
    policy = parse_policy(arguments.policy, arguments)
    if arguments.adapter:
        if policy.scripted:
            raise SpecError(f"--adapter belongs to a model, and {arguments.policy} is none; leave it out")
        policy = replace(policy, adapter=arguments.adapter)
    return policy, policy.apply(spec)


def _print_step(task: Task, transition: Transition) -> None:
    """One line on stderr about a step that a model took, as it takes it."""
    flag = "" if transition.decision.valid else " (invalid)"
    reward = f" {transition.reward:+.2f}" if transition.reward else ""
    text = " ".join(transition.action_text.split())[:80]
    print(f"seed {task.seed} step {transition.step}: {text}{flag}{reward}", file=sys.stderr, flush=True)


def _print_outcome(trajectory: Trajectory) -> None:
    """One line about a finished episode."""
    from agentspec.metrics import columns, episode_row

    row = episode_row(trajectory)
    if not trajectory.scorable:
        return
    parts = [f"{m.heading} {m.show(row[m.name])}" for m in columns([row]) if m.name not in UNTOLD]
    print(f"seed {trajectory.task.seed}: {', '.join(parts)} (ended by {row['ended']})", flush=True)


def _print_json(trajectories: Sequence[Trajectory]) -> None:
    """With several episodes a line for each; the last line is the outcome, or the mean over unfailed episodes."""
    from agentspec.metrics import outcome

    outcomes = [outcome(t) for t in trajectories]
    if len(outcomes) == 1:
        print(json.dumps(outcomes[0]))
        return
    for trajectory, result in zip(trajectories, outcomes, strict=True):
        print(json.dumps({"seed": trajectory.task.seed, "status": trajectory.status, **result}))
    scored = [o for t, o in zip(trajectories, outcomes, strict=True) if t.scorable]
    means: dict[str, Any] = {}
    for name in outcomes[0]:
        values = [o[name] for o in scored if o[name] is not None]
        means[name] = sum(values) / len(values) if values else None
    print(json.dumps({**means, "episodes": len(scored), "failed": len(outcomes) - len(scored)}))
