"""Retroformer on DeliveryBench: a reflector trained on what its lessons are worth to a frozen courier.

    python recipes/retroformer_delivery.py --config recipes/configs/retroformer_cpu.yaml

The trained reflector lies in `output_dir`, the frozen actor in its folder `actor`. The table at the end says what
lessons bring on held-out shifts: each is played, reflected on if it was not good enough, and played again, with the
reflector as it was before training and as it is after, and with a lesson that means nothing: any text in its prompt
changes what a courier does, so a reflector has taught something only where it beats that one.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from recipes.common import CONFIGS, run_recipe, train_and_draw

CONTROL = "The sky was clear in the morning, and a light wind came from the west."
"""What stands in the place of every lesson in the comparison: as long as a lesson, and no advice."""


def main() -> None:
    """Train the reflector, draw the curve of gains, evaluate: `evaluation.md` and `evaluation.jsonl`."""
    from trainers.arguments import parse_config

    config = parse_config(default=CONFIGS / "retroformer_cpu.yaml")
    from trainers.policy import load_actor_and_reflector
    from trainers.retroformer import RetroformerTrainer, as_retroformer

    config = as_retroformer(config)
    trainer = train_and_draw(config, trainer_class=RetroformerTrainer, load=load_actor_and_reflector)
    if trainer.accelerator.is_main_process:
        evaluate_run(config, Path(config.output_dir))


def evaluate_run(config: Any, folder: Path) -> list[dict[str, Any]]:
    """Two trials of every held-out task with each reflector and without one (`CONTROL`): rows, also in `folder`."""
    from agentspec.episode import Job, Runner
    from agentspec.files import write_atomic, write_lines
    from agentspec.spec import ModuleSpec
    from agentspec.tasks import make_tasks
    from eval.lessons import markdown
    from trainers.policy import load_actor_and_reflector
    from trainers.retroformer import ADAPTERS, has_lesson, play_trials
    from trainers.rollouts import collect, local_llm

    name, options = config.world
    jobs = [Job(task, 0, config.seed) for task in make_tasks(name, options, config.eval_tasks, split="test")]
    spec = replace(config.spec, sampling=replace(config.spec.sampling, **config.evaluation_sampling))
    rows = []
    reflection = ModuleSpec(spec.reflection.name, {**spec.reflection.params, "control": CONTROL})
    without = replace(spec, reflection=reflection)
    reflectors = (("meaningless lesson", "", without), ("before training", "", spec), ("after training", folder, spec))
    for label, run, agent in reflectors:
        model, tokenizer = load_actor_and_reflector(config, run)
        runner = Runner(
            agent, local_llm(model, tokenizer, adapters=ADAPTERS), timeout_s=config.env_timeout_s, policy=label
        )
        played = play_trials(partial(collect, runner, rewards=config.reward_set), jobs)
        firsts, lasts = ([episode.trajectory for episode in trials] for trials in played)
        for first, last in zip(firsts, lasts, strict=True):
            returns = [t.metrics["return"] if t.scorable else None for t in (first, last)]
            written = [c.text for c in last.calls if c.tag.purpose == "reflect"] if agent is spec else [CONTROL]
            lesson = "".join(written) if has_lesson(last) else ""
            row = {"reflector": label, "task": first.task.key, "seed": first.task.seed, "lesson": lesson}
            rows.append(row | dict(zip(("first_return", "second_return"), returns, strict=True)))
    write_lines(folder / "evaluation.jsonl", rows)
    table = markdown(rows)
    write_atomic(folder / "evaluation.md", table)
    print(table)
    return rows


if __name__ == "__main__":
    run_recipe(main)
