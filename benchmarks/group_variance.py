"""On which tasks do rollouts of one task differ? Groups of a player that mostly knows, without a model.

    python -m benchmarks.group_variance --steps 12 24 40 --tasks 16 --group 6

Plays DeliveryBench (tiny city, compact texts, menu) with the scripted expert, whose choice is replaced by a random one
with probability `--chance`: a stand-in for a policy that is neither lost nor perfect. Printed for each number of steps:
mean return, standard deviation within groups (what GRPO divides by), groups in which all rollouts earned the same (they
teach nothing), and steps played (what a rollout costs).
"""

from __future__ import annotations

import argparse
import random
import statistics

from agentspec.envs import experts
from agentspec.envs.making import make_env
from agentspec.tasks import make_tasks
from agentspec.types import Task

HOURS = {12: 0.3, 24: 0.3, 40: 1.0}
"""Steps -> hours of the shift; others have 0.3."""


def episode(task: Task, chance: float, seed: int) -> tuple[float, int]:
    """Return and steps of one rollout."""
    env = make_env(task)
    _, info = env.reset(seed=task.seed)
    rng, expert = random.Random(seed), experts.player(task.env, "rule_based", task.options, random.Random(0))
    total, steps, ended = 0.0, 0, False
    while not ended:
        action = expert.act({"state": info["state"], "action_schema": info["action_schema"]})
        if rng.random() < chance:
            action = rng.choice(info["action_schema"].choices)
        _, reward, terminated, truncated, info = env.step(action)
        total, steps, ended = total + float(reward), steps + 1, terminated or truncated
    env.close()
    return total, steps


def main() -> None:
    """Print one line per number of steps."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0], allow_abbrev=False)
    parser.add_argument("--steps", type=int, nargs="+", default=[12, 24, 40], help="steps of an episode")
    parser.add_argument("--tasks", type=int, default=16, help="tasks, each played by one group")
    parser.add_argument("--group", type=int, default=6, help="rollouts of a task")
    parser.add_argument("--chance", type=float, default=0.1, help="probability of a random choice")
    options = parser.parse_args()
    world = {"size": "tiny", "city_seed": 0, "observation": "compact", "action_mode": "menu"}
    for steps in options.steps:
        given = {**world, "shift_hours": HOURS.get(steps, 0.3), "max_steps": steps}
        tasks = make_tasks("deliverybench", given, options.tasks)
        groups = [[episode(task, options.chance, seed) for seed in range(options.group)] for task in tasks]
        returns = [[total for total, _ in group] for group in groups]
        spread = [statistics.stdev(values) for values in returns]
        print(
            f"{steps} steps of {given['shift_hours']} h: return {statistics.mean(map(statistics.mean, returns)):.2f}, "
            f"deviation within groups {statistics.mean(spread):.2f}, groups without {sum(s < 1e-6 for s in spread)} of "
            f"{len(groups)}, {statistics.mean(n for group in groups for _, n in group):.1f} steps played",
            flush=True,
        )


if __name__ == "__main__":
    main()
