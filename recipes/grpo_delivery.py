"""GRPO inside the scaffold, in the world that the configuration names.

    accelerate launch recipes/grpo_delivery.py --config recipes/configs/quickstart_cpu.yaml    # DeliveryBench
    accelerate launch recipes/grpo_delivery.py --config recipes/configs/minigrid_cpu.yaml
    accelerate launch recipes/grpo_delivery.py --config recipes/configs/alfred_cpu.yaml

Without arguments the CPU quick-start runs. Every field of the config can be given on the command line; `--resume`
continues from the last checkpoint. On a GPU machine only the config changes (`qwen3_4b_paper.yaml`).
"""

from __future__ import annotations

from recipes.common import CONFIGS, run_recipe, train_and_draw


def main() -> None:
    """Train, save the adapter, draw the reward curve."""
    from trainers.arguments import parse_config

    train_and_draw(parse_config(default=CONFIGS / "quickstart_cpu.yaml"))


if __name__ == "__main__":
    run_recipe(main)
