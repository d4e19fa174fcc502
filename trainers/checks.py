"""Every refusal of a training configuration: what cannot work, would not be exact, or would change nothing.

Each check says what was given, why it cannot be, and what to set. All of them look at the configuration alone, so that
a mistake is told before a model is loaded; what shows only later is refused where it shows (`trainers.distributed`).
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING, Any, get_args

from agentspec.actions import suggest
from agentspec.llm.batching import Batching
from agentspec.reflection.retroformer import PATH
from agentspec.registry import REGISTRY, SpecError
from agentspec.spec import MODULE_KINDS, AgentSpec
from agentspec.tags import matches
from agentspec.tasks import episode_key, make_tasks
from trainers.estimators import ESTIMATORS
from trainers.losses import LOSSES, loss
from trainers.sequences import TrainFilter
from trainers.unread import REFLECTION, unread_with_a_value
from trainers.writes import write_credit

if TYPE_CHECKING:
    from trainers.config import ScaffoldConfig

TOKEN_MODES = ("token_truncate", "token_mask")
REWARD = "reflection_gain"
REPORTERS = ("tensorboard", "wandb")
"""Where logs may go, each the name of the extra that installs it."""

NAMES: dict[str, Collection[str]] = {
    "estimator": ESTIMATORS,
    "normalize": ("token", "rollout"),
    "overlong": ("mask", "keep", "drop"),
    "overlong_ends": ("context", "budget", "max_steps", "truncated"),
    "train_credits": ("executed", "explored", "aux"),
    "memory_carry": ("first", "best"),
    "scaffold_groups": ("across", "within"),
    "packing": ("tree", "padded"),
    "reference": ("initial", "base"),
    "batching": ("auto", *get_args(Batching)),
}
"""Field -> its alternatives, or those of each of its values."""

RANGES: dict[tuple[float, float], str] = {
    (0, 1): "gamma top_entropy_quantile",
    (0, math.inf): "gigpo_weight epsilon epsilon_high beta learning_rate actor_temperature tokens_per_forward "
    "rollout_concurrency retries lora_r lora_layers lora_alpha eval_tasks",
    (0.001, math.inf): "env_timeout_s",
    (1, math.inf): "max_completion_length num_iterations train_tasks validation_tasks write_rerolls write_points",
}
"""Smallest and largest value that means something -> fields; others would turn a sign around, or be passed over."""


def check(config: ScaffoldConfig) -> None:
    """Refuse (`SpecError`) what cannot work, would not be exact, or would change nothing."""
    _ = config.reward_set, config.world, config.other_specs, config.starting_memory, config.evaluation_specs
    AgentSpec.from_data({"sampling": config.evaluation_sampling})
    check_reporters(config)
    for found in (_values, unread_with_a_value, _calls, _writes, _rounds, _vllm):
        for problem in found(config):
            raise SpecError(problem)


def check_reporters(config: Any) -> None:
    """What logs are sent through is installed."""
    for name in [config.report_to] if isinstance(config.report_to, str) else config.report_to or []:
        if name in REPORTERS and importlib.util.find_spec(name) is None:
            install = f"pip install 'agentspec-rl[{name}]'"
            raise SpecError(f"report_to names {name}, which is not installed; {install}, or set `report_to: none`")


def _values(config: ScaffoldConfig) -> Iterator[str]:
    """Every name is among its alternatives, every number means something."""
    for name, known in NAMES.items():
        value = getattr(config, name)
        for one in value if isinstance(value, (list, tuple)) else [value]:
            if one not in known:
                yield f"unknown {name} {one!r}{suggest(one, known)}"
    for (low, high), names in RANGES.items():
        for name, value in ((n, getattr(config, n)) for n in names.split()):
            if value is not None and not (low <= value <= high and math.isfinite(value)):
                most = "" if math.isinf(high) else f" and at most {high:g}"
                yield f"{name} is {value}; expected a number of at least {low:g}{most}"


def _calls(config: ScaffoldConfig) -> Iterator[str]:
    """Something is trained, and sampled so that it can be."""
    specs, train = config.mixture, config.train_filter
    paths = [path for spec in specs for path in spec.call_paths()]
    for name in ("train_calls", "train_credits"):
        if not getattr(config, name):
            yield f"{name} is empty, so nothing would be trained; name some, or leave the field out"
    for name, patterns in (("train_calls", config.train_calls), ("mask_truncated", config.mask_truncated)):
        if missing := [p for p in patterns if not any(matches(path, p) for path in paths)]:
            there = ", ".join(sorted(set(paths))) or "none (no module calls the model)"
            yield f"{name} {missing} match no call of this scaffold, so they would change nothing; its calls: {there}"
    for spec in specs:
        yield from _trainable(spec, train)
    over = any(spec.scope == "run" for spec in specs) or config.write_credit != "episode"
    odd = config.scaffold_groups == "across" and config.num_generations % len(specs)
    if config.scaffolds is not None and (over or odd):
        yield (
            f"scaffolds: the {config.num_generations} rollouts of a group are dealt out over {len(specs)} scaffolds; "
            "that takes a multiple of them as num_generations, `scope: episode` and `write_credit: episode`"
        )
    if config.adapter and config.lora_r == 0:
        yield f"adapter {config.adapter!r} with lora_r 0: all weights would be trained; merge it into a model"


def _trainable(spec: AgentSpec, train: TrainFilter) -> Iterator[str]:
    """What is trained of a scaffold is sampled so that it can be."""
    temperatures = {"sampling.temperature": spec.sampling.temperature}
    for kind in MODULE_KINDS:
        if why := REGISTRY.get(kind, getattr(spec, kind).name).declaration.untrainable:
            yield (
                f"agent.{kind} {getattr(spec, kind).name!r} cannot be trained through: {why}; train inside a method of "
                "this package, and evaluate with this one"
            )
        if any(train.matches(p) for p in spec.call_paths() if p.startswith(f"{kind}.")):
            given = getattr(spec, kind).params.items()
            temperatures |= {f"{kind}.{n}": v for n, v in given if n.endswith("temperature") and v is not None}
    for name, value in temperatures.items():
        if value <= 0:
            yield f"agent.{name} is {value}, and its calls are trained: greedy choices have no gradient; set it above 0"
    if "images" in spec.needs():
        yield "agent.perception has images: true, and the policy under training reads text only; leave them out"
    if spec.sampling.top_p < 1 or spec.sampling.top_k > 0:
        yield (
            "agent.sampling sets top_p or top_k: the update recomputes log-probabilities over the full distribution "
            "and would not match the sampled ones; train with top_p 1 and top_k 0"
        )


def own_memory_paths(config: ScaffoldConfig) -> list[str]:
    """Paths of the calls of memory that the policy answers, and no helper model."""
    agent = config.spec
    helped = {m for pattern in agent.roles for m in agent.helped(pattern)}
    return [p for p in agent.call_paths() if p.startswith("memory.") and p.partition("/")[0] not in helped]


def _writes(config: ScaffoldConfig) -> Iterator[str]:
    """Estimators of a write have writes to credit."""
    spec, roles = write_credit(config.write_credit), config.spec.roles
    if spec.function is None:
        return
    if roles and spec.reads:
        yield (
            f"write_credit {spec.name!r} with roles {list(roles)}: an episode is played again from its recorded "
            "answers, and those of helper models are not given back; use `write_credit: ablation`, or no helper"
        )
    paths = own_memory_paths(config)
    if not any(config.train_filter.matches(p) and matches(p, config.write_calls) for p in paths):
        yield (
            f"write_credit {spec.name!r}, but no call of memory {config.spec.memory.name!r} is both trained "
            f"(train_calls {config.train_calls}) and a write (write_calls {config.write_calls}); its calls are "
            f"{', '.join(paths) or 'none that the policy answers'}; add 'memory.*' to train_calls"
        )


def _rounds(config: ScaffoldConfig) -> Iterator[str]:
    """An update reads one generation round, whole or in equal parts; rewards as configured; the best one kept."""
    accumulated, made = config.gradient_accumulation_steps, config.steps_per_generation
    rollouts, group = config.generation_batch_size or 0, config.num_generations
    if made % accumulated:
        yield (
            f"gradient_accumulation_steps {accumulated} with steps_per_generation {made}: an update would mix rounds, "
            f"each with a denominator of its own; set steps_per_generation to {accumulated}, or to a multiple of it"
        )
    if config.train_tasks < rollouts // group:
        yield (
            f"train_tasks is {config.train_tasks}, and a generation round takes {rollouts // group} different tasks "
            f"({rollouts} rollouts in groups of {group}): not one round could be played; set train_tasks to at least "
            f"{rollouts // group}, or lower gradient_accumulation_steps"
        )
    saves = getattr(config.save_strategy, "value", config.save_strategy)
    stepwise = config.validates and saves == config.eval_strategy == "steps"
    if stepwise and (config.eval_steps or 0) % config.save_steps:
        yield (
            f"eval_steps {config.eval_steps} is no multiple of save_steps {config.save_steps}, so the best update may "
            "have no checkpoint; make it one, or set `save_strategy: best`"
        )
    if config.normalize == "rollout" and not loss(config.loss_type).per_token:
        others = ", ".join(name for name, spec in LOSSES.items() if spec.per_token)
        yield f"normalize 'rollout' with loss_type {config.loss_type!r}, no mean over tokens; use one of {others}"


def _vllm(config: ScaffoldConfig) -> Iterator[str]:
    """Nothing that TRL offers for whole rows, or for all ranks at once."""
    if not config.use_vllm:
        return
    mode = config.vllm_importance_sampling_mode
    if config.vllm_batch_invariant and config.vllm_mode != "colocate":
        yield (
            f"vllm_batch_invariant is true with vllm_mode {config.vllm_mode}: a server's arithmetic is set where it is "
            "started; start it as `VLLM_BATCH_INVARIANT=1 vllm serve ...` and leave the field out"
        )
    if config.vllm_tensor_parallel_size != 1:
        yield (
            f"vllm_tensor_parallel_size is {config.vllm_tensor_parallel_size} with vllm_mode colocate: its engine "
            "needs the same requests at the same moment on several processes, but each plays episodes of its own; use "
            "1, or vllm_mode: server (`vllm serve --tensor-parallel-size ...`)"
        )
    if config.vllm_importance_sampling_correction and mode not in TOKEN_MODES:
        modes = ", ".join(TOKEN_MODES)
        yield f"vllm_importance_sampling_mode {mode!r} speaks of rows, and an episode may have several; use {modes}"


def check_retroformer(config: ScaffoldConfig) -> None:
    """Refuse (`SpecError`) what does not train a reflector beside a frozen actor."""
    for problem in _retroformer(config):
        raise SpecError(problem)


def _retroformer(config: ScaffoldConfig) -> Iterator[str]:
    reflection, given = config.spec.reflection, config.spec.reflection.params
    if reflection.name != REFLECTION:
        yield f"the reflector is trained in `reflection: {REFLECTION}`; the agent has {reflection.name!r}"
    if given.get("when") != "start" or config.spec.scope != "run":
        yield (
            "a lesson and the trial that pays it must be one episode that starts from the failed trial's memory: set "
            f"`reflection: {{name: {REFLECTION}, when: start}}` and `scope: run`"
        )
    if given.get("control"):
        yield "reflection.control: a fixed text stands for every lesson, so none is sampled; leave it out"
    if given.get("temperature") == 0:
        yield "reflection.temperature is 0: all lessons of a group would be the same; set it above 0"
    if config.start_memory:
        yield "start_memory: lessons are about first trials, which start from nothing; leave it out"
    if config.train_calls != [PATH]:
        yield f"train_calls {config.train_calls}: the actor is frozen; only [{PATH!r}] is trained"
    if REWARD not in config.reward_set.weights:
        yield f"rewards {config.rewards}: a lesson is paid the change of return; give {REWARD!r} a weight"
    if config.write_credit != "episode":
        yield f"write_credit {config.write_credit!r}: only the lesson is trained, no write of a memory"
    if config.lora_r == 0:
        yield "lora_r is 0: all weights would be trained, the actor's among them; give the reflector a rank"
    if config.use_vllm:
        yield "use_vllm: its engine holds one set of weights, and actor and reflector differ; set `use_vllm: false`"
    played = config.per_device_train_batch_size * config.steps_per_generation
    if played % config.num_generations:
        yield (
            f"{played} rollouts per process are no whole groups of {config.num_generations}: lessons about one failed "
            "trial are written where it was played"
        )


def notes(config: ScaffoldConfig) -> Iterator[str]:
    """What a user should know about a configuration that runs."""
    spec = loss(config.loss_type)
    cap = config.epsilon if config.epsilon_high is None else config.epsilon_high
    memory = [p for p in config.spec.call_paths() if p.startswith("memory.") and config.train_filter.matches(p)]
    if spec.depends_on_rows:
        yield f"loss_type {spec.name}: {spec.depends_on_rows}; 'dapo' does not depend on rows"
    if spec.name == "cispo" and cap < 1:
        yield (
            f"loss_type cispo: epsilon_high {cap:g} is a bound of the ratio itself, so every token near its ratio of 1 "
            f"is capped and its gradient is {cap:g} of the policy gradient; its authors' bound is 5"
        )
    if memory and "aux" not in config.train_credits and config.spec.memory.name != "summary":
        yield (
            f"train_calls match {', '.join(memory)}, and train_credits {config.train_credits} lack 'aux': what a "
            "memory asks is help unless it says otherwise, so nothing of it is trained"
        )
    if config.top_entropy_quantile < 1:
        yield "top_entropy_quantile: the quantile is of each micro-batch, so it depends on how rows are split"
    yield from _seen(config)


def _seen(config: ScaffoldConfig) -> Iterator[str]:
    """Held-out tasks that are training tasks all the same, in worlds of few episodes."""
    trained = {episode_key(task) for task in make_tasks(*config.world, config.train_tasks)}
    validated = config.validation_tasks if config.validates else 0
    for split, count in (("validation", validated), ("test", config.eval_tasks)):
        tasks = make_tasks(*config.world, count, split=split)
        if seen := sum(episode_key(task) in trained for task in tasks):
            yield f"{seen} of {count} tasks of the {split} split are episodes that are trained on: seeds repeat them"
