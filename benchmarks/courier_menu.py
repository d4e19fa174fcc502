"""What the menu keeps of the earnings: the rule-based courier natively and through the menu, in the same shifts.

    python -m benchmarks.courier_menu [--json] [--sizes small medium] [--cities 4] [--seeds 2]

Generated cities of the test split, one-hour shifts, fair rules. Per size: dollars per hour natively and through the
menu, their ratio, the share of answers that turn the page, steps per shift, and the length of the menu and of the
compact text. The exit status is 0 only if every size keeps `GOAL`.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Sequence
from typing import Any

from agentspec.envs.deliverybench.city.generate import PLANS, SPLITS
from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.expert.courier import RuleBasedCourier
from agentspec.envs.deliverybench.view.menu import MORE

GOAL = 0.8
MENU: dict[str, Any] = {"action_mode": "menu", "observation": "compact"}


def shift(seed: int, options: dict[str, Any]) -> dict[str, float]:
    """One shift of the rule-based courier: what it earned, and how the answers were distributed."""
    env = DeliveryBenchEnv(**options)
    courier = RuleBasedCourier(env.city)
    observation, info = env.reset(seed=seed)
    steps = turns = 0
    choices, characters, ended = [], [], False
    while not ended:
        choices.append(len(info["action_schema"].choices))
        characters.append(len(observation["text"]))
        answer = courier.act(info)
        observation, _, terminated, truncated, info = env.step(answer)
        steps, turns = steps + 1, turns + (answer == MORE.text)
        ended = terminated or truncated
    return {
        "profit": info["metrics"]["hourly_profit"],
        "deliveries": info["metrics"]["deliveries"],
        "steps": steps,
        "turns": turns / steps,
        "choices": statistics.mean(choices),
        "characters": statistics.mean(characters),
    }


def row(size: str, cities: int, seeds: int) -> dict[str, Any]:
    """Means over all shifts of a size."""
    first = SPLITS["test"].start
    jobs = [(seed, {"size": size, "city_seed": c}) for c in range(first, first + cities) for seed in range(seeds)]
    native = [shift(seed, options) for seed, options in jobs]
    menu = [shift(seed, {**options, **MENU}) for seed, options in jobs]
    means = {f"menu_{key}": statistics.mean(s[key] for s in menu) for key in menu[0]}
    means |= {f"native_{key}": statistics.mean(s[key] for s in native) for key in ("profit", "deliveries", "steps")}
    return {"size": size, "shifts": len(jobs), **means, "kept": means["menu_profit"] / means["native_profit"]}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as a Markdown table."""
    lines = [
        "| cities | shifts | native ($/h) | menu ($/h) | kept | steps | steps, menu | turned | choices | characters |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for r in rows:
        lines.append(
            f"| {r['size']} | {r['shifts']} | {r['native_profit']:.0f} | {r['menu_profit']:.0f} | {r['kept']:.0%} | "
            f"{r['native_steps']:.0f} | {r['menu_steps']:.0f} | {r['menu_turns']:.1%} | {r['menu_choices']:.1f} | "
            f"{r['menu_characters']:.0f} |"
        )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__.partition("\n")[0])
    parser.add_argument("--sizes", nargs="+", choices=list(PLANS), default=["small"])
    parser.add_argument("--cities", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args(argv)
    rows = [row(size, arguments.cities, arguments.seeds) for size in arguments.sizes]
    print(json.dumps(rows) if arguments.json else table(rows))
    return 0 if all(r["kept"] >= GOAL for r in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
