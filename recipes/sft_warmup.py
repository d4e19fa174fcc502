"""A supervised warm start from a world's scripted expert, in the scaffolds that GRPO will use.

    accelerate launch recipes/sft_warmup.py --config recipes/configs/warmup_cpu.yaml
    accelerate launch recipes/sft_warmup.py --config recipes/configs/warmup_minigrid.yaml
    accelerate launch recipes/sft_warmup.py --config recipes/configs/warmup_mixture_minigrid.yaml
    accelerate launch recipes/sft_warmup.py --environment '{"name": "alfred", "options": {"action_mode": "menu"}}'

Any environment with an expert will do (`agentspec.envs.experts`). The first two made the adapters that ship
(`agentspec/llm/shipped`). With `scaffolds` the expert plays through all of them (`agentspec.mixture`), and one adapter
learns to act in each. TRL's `SFTTrainer` trains on the tokens the expert chose; prompts and observations are context.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from recipes.common import CONFIGS, run_recipe


def main() -> None:
    """Demonstrate, train, save the adapter."""
    from trainers.arguments import parse_config

    train_warmup(parse_config(default=CONFIGS / "warmup_cpu.yaml"))


def train_warmup(config: Any) -> None:
    """Supervised training as `config` says: `train_tasks` demonstrations, `num_train_epochs` passes."""
    from datasets import Dataset
    from trl import SFTConfig

    from agentspec.files import write_atomic
    from agentspec.records.log import RunLog
    from agentspec.tasks import make_tasks
    from trainers.card import FILE, model_card
    from trainers.config import CHECKPOINTING
    from trainers.demonstrations import DemonstrationTrainer, demonstrate
    from trainers.policy import load_policy

    name, options = config.world
    model, tokenizer = load_policy(config)
    tasks = make_tasks(name, options, config.train_tasks)
    rows, episodes = demonstrate(config.mixture, tokenizer, tasks, config.train_filter, config.seed)
    returns = [float(t.metrics["return"]) for t in episodes]
    print(f"{len(returns)} demonstrations, mean return {sum(returns) / len(returns):.2f}, {len(rows)} rows")
    same = (
        "output_dir per_device_train_batch_size gradient_accumulation_steps num_train_epochs max_steps learning_rate "
        "lr_scheduler_type warmup_steps logging_steps report_to use_cpu bf16 seed"
    )
    given = {field: getattr(config, field) for field in (*same.split(), CHECKPOINTING)}
    args = SFTConfig(**given, max_length=None, save_strategy="no")
    data = Dataset.from_list(rows)
    trainer = DemonstrationTrainer(model, args, train_dataset=data, processing_class=tokenizer)
    trainer.train()
    trainer.save_model(config.output_dir)
    card = model_card(Path(config.output_dir).name, vars(config), config.spec.to_data(), adapter=bool(config.lora_r))
    write_atomic(Path(config.output_dir) / FILE, card)
    log = RunLog(Path(config.output_dir))
    log.manifest(config=config.to_dict(), spec=config.spec.to_data(), demonstrations=len(returns))


if __name__ == "__main__":
    run_recipe(main)
