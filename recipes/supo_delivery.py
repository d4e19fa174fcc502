"""SUPO on DeliveryBench: GRPO with trained summaries every eight actions.

    accelerate launch recipes/supo_delivery.py --config recipes/configs/supo_cpu.yaml

The same trainer as `grpo_delivery.py`; the scaffold's memory replaces the conversation by the policy's own summary,
and the summary's tokens are trained with the rollout's advantage.
"""

from __future__ import annotations

from recipes.common import CONFIGS, run_recipe, train_and_draw


def main() -> None:
    """Train with summaries, save the adapter, draw the reward curve."""
    from trainers.arguments import parse_config
    from trainers.presets import as_supo

    train_and_draw(as_supo(parse_config(default=CONFIGS / "supo_cpu.yaml")))


if __name__ == "__main__":
    run_recipe(main)
