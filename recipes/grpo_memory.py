"""GRPO with a memory in the loop: the policy that acts also writes its notes, and both are trained.

    python recipes/grpo_memory.py --config recipes/configs/memory_cpu.yaml --write_credit local

The agent is `react` with a cheat sheet (`dynamic_cheatsheet`) that the policy rewrites every few steps; the tokens of
the sheet are trained like those of the actions. What a rewrite earns is `write_credit`: the `episode`'s advantage,
`local` re-rolls with and without it, or the `ablation` of the whole memory (docs/training.md).
"""

from __future__ import annotations

from recipes.common import CONFIGS, run_recipe, train_and_draw


def main() -> None:
    """Train actions and notes, save the adapter, draw the reward curve."""
    from trainers.arguments import parse_config
    from trainers.presets import as_memory

    train_and_draw(as_memory(parse_config(default=CONFIGS / "memory_cpu.yaml")))


if __name__ == "__main__":
    run_recipe(main)
