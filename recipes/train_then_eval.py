"""Train a policy, then evaluate base and trained policy under several scaffolds on held-out tasks: one table.

    accelerate launch recipes/train_then_eval.py --config recipes/configs/quickstart_cpu.yaml

The table answers the project's question in small: does what was learnt inside one scaffold carry over to another?
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from recipes.common import CONFIGS, run_recipe, train_and_draw


def main() -> None:
    """Train, draw the reward curve, evaluate, write `evaluation.md` and the episodes under `evaluation/`."""
    from trainers.arguments import parse_config

    config = parse_config(default=CONFIGS / "quickstart_cpu.yaml")
    if train_and_draw(config).accelerator.is_main_process:
        evaluate_run(config, Path(config.output_dir))


def evaluate_run(config: Any, folder: Path) -> None:
    """Base and trained policy, and the rule-based expert, under every evaluation scaffold of `config`."""
    from agentspec.llm.models import resolve_adapter
    from agentspec.tasks import make_tasks
    from eval.matrix import Policy, evaluate
    from eval.tables import markdown

    name, options = config.world
    tasks = make_tasks(name, options, config.eval_tasks, split="test")
    specs = {s.label: s for s in config.evaluation_specs}
    start = resolve_adapter(config.adapter) if config.adapter else ""
    policies = [
        Policy("start", model=config.model, adapter=start),
        Policy("trained", model=config.model, adapter=str(folder))
        if config.lora_r
        else Policy("trained", model=str(folder)),
        Policy("rule_based"),
        Policy("random"),
    ]
    rows = evaluate(policies, specs, tasks, out=folder / "evaluation", sampling=config.evaluation_sampling)
    table = markdown(rows)
    (folder / "evaluation.md").write_text(table, encoding="utf-8")
    print(table)


if __name__ == "__main__":
    run_recipe(main)
