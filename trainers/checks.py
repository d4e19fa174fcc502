"""Every refusal of a training configuration: what cannot work, would not be exact, or would change nothing.

Each check says what was given, why it cannot be, and what to set. All of them look at the configuration alone, so that
a mistake is told before a model is loaded; what shows only later is refused where it shows (`trainers.distributed`).
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Collection, Iterable
from dataclasses import fields
from typing import TYPE_CHECKING, Any, get_args

from trl import GRPOConfig

from agentspec.actions import suggest
from agentspec.llm.batching import Batching
from agentspec.reflection.retroformer import PATH
from agentspec.registry import REGISTRY, SpecError
from agentspec.spec import MODULE_KINDS
from trainers.estimators import ESTIMATORS, estimator
from trainers.fields import field_rules
from trainers.losses import LOSSES, loss
from trainers.sequences import TrainFilter, unmatched_patterns
from trainers.writes import write_credit

if TYPE_CHECKING:
    from trainers.config import ScaffoldConfig

ENDS = ("context", "budget", "max_steps", "truncated")
TOKEN_MODES = ("token_truncate", "token_mask")
REFLECTION, REWARD = "retroformer", "reflection_gain"
LORA_FIELDS = ("lora_r", "lora_alpha", "lora_targets", "lora_layers")
REPORTERS = ("tensorboard", "wandb")
"""Where logs may go, each the name of the extra that installs it."""


def check(config: ScaffoldConfig) -> None:
    """Refuse what cannot work, would not be exact, or would change nothing.

    Raises:
        SpecError: what was given, why it cannot work, what to do.
    """
    _ = config.reward_set, config.world, config.other_specs, config.starting_memory
    check_fields(config)
    check_reporters(config)
    check_names(config)
    check_calls(config)
    check_lora(config)
    check_actor(config)
    check_ranges(config)
    check_writes(config)
    check_loss(config)
    check_rounds(config)
    check_validation(config)
    check_vllm(config)


def check_fields(config: Any) -> None:
    """No field of TRL's that nobody reads has a value of its own."""
    rules = field_rules(GRPOConfig)
    for name, rule in rules.items():
        value = getattr(config, name, rule.allowed[0] if rule.allowed else None)
        if rule.status != "used" and value not in rule.allowed:
            _refuse_field(name, value)
    if (
        config.max_completion_length != _default(config, "max_completion_length")
        and "max_completion_length" not in loss(config.loss_type).uses
    ):
        raise SpecError(
            f"max_completion_length is {config.max_completion_length}, which only loss_type 'dr_grpo' reads (as its "
            "constant length); the length of an answer is set under `agent: {sampling: {max_tokens: ...}}`"
        )


def check_given(names: Iterable[str], where: str) -> None:
    """Refuse fields that a user names and nobody reads, whatever their value.

    Args:
        names: keys of a YAML file, or options of a command line.
        where: what they were read from, for the message.
    """
    rules = field_rules(GRPOConfig)
    for name in names:
        if name in rules and rules[name].status == "refused":
            raise SpecError(f"{where}: `{name}` is not read: {rules[name].why}")


def _refuse_field(name: str, value: Any) -> None:
    rule = field_rules(GRPOConfig)[name]
    verb = "is not read" if rule.status == "refused" else f"must be {rule.allowed[0]!r}"
    raise SpecError(f"{name} is {value!r}, and it {verb}: {rule.why}")


def check_reporters(config: Any) -> None:
    """What logs are sent through is installed."""
    for name in [config.report_to] if isinstance(config.report_to, str) else config.report_to or []:
        if name in REPORTERS and importlib.util.find_spec(name) is None:
            raise SpecError(
                f"report_to names {name}, which is not installed; pip install 'agentspec-rl[{name}]', or set "
                "`report_to: none`"
            )


def check_names(config: ScaffoldConfig) -> None:
    """Every name is among its alternatives."""
    for name, known in (
        ("estimator", tuple(ESTIMATORS)),
        ("normalize", ("token", "rollout")),
        ("overlong", ("mask", "keep", "drop")),
        ("memory_carry", ("first", "best")),
        ("packing", ("tree", "padded")),
        ("reference", ("initial", "base")),
        ("batching", ("auto", *get_args(Batching))),
    ):
        _known(getattr(config, name), known, name)
    for name, known in (("overlong_ends", ENDS), ("train_credits", ("executed", "explored", "aux"))):
        for value in getattr(config, name):
            _known(value, known, f"value of {name}:")


def _known(value: Any, known: Collection[str], what: str) -> None:
    if value not in known:
        raise SpecError(f"unknown {what} {value!r}{suggest(value, known)}")


def check_calls(config: ScaffoldConfig) -> None:
    """Something is trained, and sampled so that it can be."""
    spec = config.spec
    paths = spec.call_paths()
    missing = unmatched_patterns(paths, config.train_filter)
    if missing:
        raise SpecError(
            f"train_calls {missing} match no call of this scaffold, so nothing would be trained by them; its calls "
            f"come from {', '.join(sorted(set(paths))) or 'no module (none calls the model)'}"
        )
    nowhere = unmatched_patterns(paths, TrainFilter(tuple(config.mask_truncated)))
    if nowhere:
        raise SpecError(
            f"mask_truncated {nowhere} match no call of this scaffold, so nothing would be masked by them; its calls "
            f"come from {', '.join(sorted(set(paths)))}"
        )
    for kind in MODULE_KINDS:
        name = getattr(spec, kind).name
        why = REGISTRY.get(kind, name).declaration.untrainable
        if why:
            raise SpecError(
                f"agent.{kind} {name!r} cannot be trained through: {why}; train inside a method of AgentSpec's own, "
                "and evaluate with this one"
            )
    if "images" in spec.needs():
        raise SpecError(
            "agent.perception has images: true, and the policy that is trained reads text only (pictures have no token "
            "ids here); train without images, and evaluate models that see"
        )
    if config.actor_temperature < 0:
        raise SpecError(f"actor_temperature is {config.actor_temperature}; expected 0 (greedy) or above")
    if spec.sampling.temperature <= 0:
        raise SpecError("agent.sampling.temperature is 0: greedy choices have no gradient; set it above 0")
    for kind in MODULE_KINDS:
        module = getattr(spec, kind)
        own = [n for n, v in module.params.items() if n.endswith("temperature") and v is not None and v <= 0]
        if own and any(config.train_filter.matches(p) for p in paths if p.startswith(f"{kind}.")):
            raise SpecError(
                f"agent.{kind}.{own[0]} is {module.params[own[0]]}: its calls are trained (train_calls), and greedy "
                "choices have no gradient; set it above 0, or train other calls"
            )
    if spec.sampling.top_p < 1 or spec.sampling.top_k > 0:
        raise SpecError(
            "agent.sampling sets top_p or top_k: the update recomputes log-probabilities over the full "
            "distribution and would not match the sampled ones; train with top_p 1 and top_k 0"
        )


WRITE_FIELDS = ("write_rerolls", "write_points")


def check_writes(config: ScaffoldConfig) -> None:
    """Estimators of a write have writes to credit, and no setting of theirs changes nothing."""
    spec = write_credit(config.write_credit)
    for name in WRITE_FIELDS:
        if getattr(config, name) < 1:
            raise SpecError(f"{name} is {getattr(config, name)}; expected at least 1")
        if getattr(config, name) != _default(config, name) and name not in spec.reads:
            raise SpecError(
                f"{name} {getattr(config, name)} changes nothing with write_credit {spec.name!r}; leave it out, or set "
                "`write_credit: local`"
            )
    if spec.function is None:
        if config.write_calls != _default(config, "write_calls"):
            raise SpecError(
                f"write_calls {config.write_calls} changes nothing with write_credit 'episode'; leave it out"
            )
        return
    agent = config.spec
    if agent.roles and spec.reads:
        raise SpecError(
            f"write_credit {spec.name!r} with roles {list(agent.roles)}: an episode is played again from its recorded "
            "answers, and those of helper models are not given back; use `write_credit: ablation`, or no helper"
        )
    helped = {m for pattern in agent.roles for m in agent.helped(pattern)}
    paths = [p for p in agent.call_paths() if p.startswith("memory.") and p.partition("/")[0] not in helped]
    trained = [p for p in paths if config.train_filter.matches(p) and TrainFilter(tuple(config.write_calls)).matches(p)]
    if not trained:
        raise SpecError(
            f"write_credit {spec.name!r}, but no call of memory {agent.memory.name!r} is both trained (train_calls "
            f"{config.train_calls}) and a write (write_calls {config.write_calls}); its calls are "
            f"{', '.join(paths) or 'none that the policy answers'}; add 'memory.*' to train_calls"
        )


def check_lora(config: ScaffoldConfig) -> None:
    """A warm start keeps the shape it was made with, and all weights have no shape of an adapter."""
    if not config.adapter:
        for name in LORA_FIELDS[1:]:
            if config.lora_r == 0 and getattr(config, name) != _default(config, name):
                raise SpecError(
                    f"{name} is {getattr(config, name)!r} with lora_r 0, which trains all weights, without an adapter; "
                    f"leave out {name}, or give lora_r a rank"
                )
        return
    if config.lora_r == 0:
        raise SpecError(
            f"adapter {config.adapter!r} with lora_r 0: all weights would be trained; merge it into a model"
        )
    for name in LORA_FIELDS:
        if getattr(config, name) != _default(config, name):
            raise SpecError(
                f"{name} is {getattr(config, name)!r} beside adapter {config.adapter!r}, whose own shape is trained; "
                f"leave out {name}, or set `adapter: ''` for a new adapter"
            )


def check_actor(config: ScaffoldConfig) -> None:
    """What belongs to a frozen actor, or to a memory that is carried on, has one."""
    spec = config.spec
    for name in ("actor_adapter", "actor_temperature"):
        if getattr(config, name) != _default(config, name) and spec.reflection.name != REFLECTION:
            raise SpecError(
                f"{name} is {getattr(config, name)!r}, and there is no frozen actor: only a reflector that is trained "
                f"(`reflection: {REFLECTION}`) acts beside one; leave out {name}"
            )
    if config.memory_carry != _default(config, "memory_carry") and spec.scope != "run":
        raise SpecError(
            f"memory_carry {config.memory_carry!r} changes nothing with agent.scope {spec.scope!r}: no memory outlives "
            "its episode; leave it out, or set `agent: {scope: run}`"
        )


RANGES: dict[str, tuple[float, float]] = {
    "gamma": (0.0, 1.0),
    "gigpo_weight": (0.0, math.inf),
    "epsilon": (0.0, math.inf),
    "epsilon_high": (0.0, math.inf),
    "beta": (0.0, math.inf),
    "top_entropy_quantile": (0.0, 1.0),
    "learning_rate": (0.0, math.inf),
    "max_completion_length": (1, math.inf),
    "num_iterations": (1, math.inf),
    "train_tasks": (1, math.inf),
    "tokens_per_forward": (0, math.inf),
    "rollout_concurrency": (0, math.inf),
    "retries": (0, math.inf),
    "lora_r": (0, math.inf),
    "lora_layers": (0, math.inf),
    "lora_alpha": (0, math.inf),
}
"""Field -> smallest and largest value that means something."""


def check_ranges(config: ScaffoldConfig) -> None:
    """Every number means something: out of its range it would turn a sign around or be passed over."""
    for name, (low, high) in RANGES.items():
        value = getattr(config, name)
        if value is not None and not (low <= value <= high and math.isfinite(value)):
            most = "" if math.isinf(high) else f" and at most {high:g}"
            raise SpecError(f"{name} is {value}; expected a number of at least {low:g}{most}")


def check_loss(config: ScaffoldConfig) -> None:
    """The loss is offered, and no setting of it or of the estimator changes nothing."""
    spec = loss(config.loss_type)
    if config.reference != _default(config, "reference") and config.beta == 0:
        raise SpecError(f"reference {config.reference!r} changes nothing with beta 0; leave it out, or set beta")
    if config.epsilon != _default(config, "epsilon") and config.epsilon_high and "epsilon" not in spec.uses:
        raise SpecError(
            f"epsilon {config.epsilon} changes nothing with loss_type {spec.name!r}, which reads epsilon_high; "
            "leave it out"
        )
    if config.delta is not None and "delta" not in spec.uses:
        raise SpecError(f"delta {config.delta} changes nothing with loss_type {spec.name!r}; leave it out")
    for name in ("gamma", "gigpo_weight"):
        if getattr(config, name) != _default(config, name) and name not in estimator(config.estimator).needs:
            readers = ", ".join(e.name for e in ESTIMATORS.values() if name in e.needs)
            raise SpecError(
                f"{name} {getattr(config, name)} changes nothing with estimator {config.estimator!r}; leave it out, or "
                f"use one that reads it: {readers}"
            )
    if config.normalize == "rollout" and not spec.per_token:
        raise SpecError(
            f"normalize 'rollout' with loss_type {spec.name!r}: its denominator is not the number of trained tokens; "
            f"use one of {', '.join(name for name, s in LOSSES.items() if s.per_token)}"
        )


def check_rounds(config: ScaffoldConfig) -> None:
    """Groups can be compared, and an update reads one generation round, whole or in equal parts."""
    if config.num_generations < 2:
        raise SpecError(f"num_generations is {config.num_generations}: a group needs at least 2 rollouts to compare")
    if config.steps_per_generation % config.gradient_accumulation_steps:
        raise SpecError(
            f"gradient_accumulation_steps {config.gradient_accumulation_steps} with steps_per_generation "
            f"{config.steps_per_generation}: an update would mix generation rounds, each with a denominator of its "
            f"own; set steps_per_generation to {config.gradient_accumulation_steps} (the same rollouts in one round), "
            "or to a multiple of it (several updates a round)"
        )
    tasks = (config.generation_batch_size or 0) // config.num_generations
    if config.train_tasks < tasks:
        raise SpecError(
            f"train_tasks is {config.train_tasks}, and a generation round takes {tasks} different tasks "
            f"({config.generation_batch_size} rollouts in groups of {config.num_generations}): not one round could be "
            f"played; set train_tasks to at least {tasks}, or lower gradient_accumulation_steps"
        )


def check_validation(config: ScaffoldConfig) -> None:
    """A checkpoint exists of whatever update turns out best."""
    if not config.validates:
        if config.validation_specs:
            raise SpecError(
                "validation_specs changes nothing without evaluation while training; set `eval_strategy: steps`, or "
                "name them as eval_specs"
            )
        return
    if config.validation_tasks < 1:
        raise SpecError(f"validation_tasks is {config.validation_tasks}: evaluation while training needs at least 1")
    saves = getattr(config.save_strategy, "value", config.save_strategy)
    if saves == "steps" and config.eval_strategy == "steps" and (config.eval_steps or 0) % config.save_steps:
        raise SpecError(
            f"eval_steps {config.eval_steps} is no multiple of save_steps {config.save_steps}, so the best update may "
            "have no checkpoint; make it one, or set `save_strategy: best`"
        )


def check_vllm(config: ScaffoldConfig) -> None:
    """Nothing that TRL offers for whole rows, or for all ranks at once."""
    if config.vllm_batch_invariant:
        _check_batch_invariant(config)
    if not config.use_vllm:
        return
    if config.vllm_mode == "colocate" and config.vllm_tensor_parallel_size != 1:
        raise SpecError(
            f"vllm_tensor_parallel_size is {config.vllm_tensor_parallel_size} with vllm_mode colocate: its engine "
            "needs the same requests at the same moment on several processes, but each plays episodes of its own; use "
            "1, or vllm_mode: server (`vllm serve --tensor-parallel-size ...`)"
        )
    if config.vllm_importance_sampling_correction and config.vllm_importance_sampling_mode not in TOKEN_MODES:
        raise SpecError(
            f"vllm_importance_sampling_mode {config.vllm_importance_sampling_mode!r} speaks of rows, and an episode "
            f"may have several; use one of {', '.join(TOKEN_MODES)}"
        )


def _check_batch_invariant(config: ScaffoldConfig) -> None:
    """`vllm_batch_invariant` can be switched on from here, and vLLM offers it."""
    if not config.use_vllm:
        raise SpecError(
            "vllm_batch_invariant is true without vLLM: it would change nothing; set `use_vllm: true`, or leave it out "
            "(the local backend tries out by itself whether a device is batch-invariant)"
        )
    if config.vllm_mode != "colocate":
        raise SpecError(
            f"vllm_batch_invariant is true with vllm_mode {config.vllm_mode}: a server's arithmetic is set where it is "
            "started, and cannot be seen from here; start it as `VLLM_BATCH_INVARIANT=1 vllm serve ...` and leave the "
            "field out"
        )


def check_retroformer(config: ScaffoldConfig) -> None:
    """Refuse what does not train a reflector beside a frozen actor."""
    spec = config.spec
    if spec.reflection.name != REFLECTION:
        raise SpecError(
            f"the reflector is trained in `reflection: {REFLECTION}`; the agent has {spec.reflection.name!r}"
        )
    if spec.reflection.params.get("when") != "start" or spec.scope != "run":
        raise SpecError(
            "a lesson and the trial that pays it must be one episode that starts from the failed trial's memory: set "
            f"`reflection: {{name: {REFLECTION}, when: start}}` and `scope: run`"
        )
    if spec.reflection.params.get("control"):
        raise SpecError("reflection.control: a fixed text stands for every lesson, so none is sampled; leave it out")
    if spec.reflection.params.get("temperature") == 0:
        raise SpecError("reflection.temperature is 0: all lessons of a group would be the same; set it above 0")
    if config.start_memory:
        raise SpecError("start_memory: lessons are about first trials, which start from nothing; leave it out")
    if config.train_calls != [PATH]:
        raise SpecError(f"train_calls {config.train_calls}: the actor is frozen; only [{PATH!r}] is trained")
    if REWARD not in config.reward_set.weights:
        raise SpecError(f"rewards {config.rewards}: a lesson is paid the change of return; give {REWARD!r} a weight")
    if config.write_credit != "episode":
        raise SpecError(f"write_credit {config.write_credit!r}: only the lesson is trained, no write of a memory")
    if config.lora_r == 0:
        raise SpecError("lora_r is 0: all weights would be trained, the actor's among them; give the reflector a rank")
    if config.use_vllm:
        raise SpecError(
            "use_vllm: the engine holds one set of weights, with the trained adapter merged in; actor and reflector "
            "differ. Use the local backend (use_vllm: false)"
        )
    if config.per_device_train_batch_size * config.steps_per_generation % config.num_generations:
        raise SpecError(
            f"{config.per_device_train_batch_size} x {config.steps_per_generation} rollouts per process are no whole "
            f"groups of {config.num_generations}: lessons about one failed trial are written where it was played"
        )


def notes(config: ScaffoldConfig) -> list[str]:
    """What a user should know about a configuration that runs."""
    found = []
    spec = loss(config.loss_type)
    if spec.depends_on_rows:
        found.append(f"loss_type {spec.name}: {spec.depends_on_rows}; 'dapo' does not depend on rows")
    cap = config.epsilon if config.epsilon_high is None else config.epsilon_high
    if spec.name == "cispo" and cap < 1:
        found.append(
            f"loss_type cispo: epsilon_high {cap:g} is a bound of the ratio itself, so every token near its ratio of 1 "
            f"is capped and its gradient is {cap:g} of the policy gradient; its authors' bound is 5"
        )
    memory = [p for p in config.spec.call_paths() if p.startswith("memory.") and config.train_filter.matches(p)]
    if memory and "aux" not in config.train_credits and config.spec.memory.name != "summary":
        found.append(
            f"train_calls match {', '.join(memory)}, and train_credits {config.train_credits} lack 'aux': what a "
            "memory asks is help unless it says otherwise, so nothing of it is trained"
        )
    if config.top_entropy_quantile < 1:
        found.append("top_entropy_quantile: the quantile is of each micro-batch, so it depends on how rows are split")
    return found


def _default(config: Any, name: str) -> Any:
    field = next(f for f in fields(config) if f.name == name)
    return field.default_factory() if callable(field.default_factory) else field.default
