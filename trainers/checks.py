"""Every refusal of a training configuration: what cannot work, would not be exact, or would change nothing.

Each check says what was given, why it cannot be, and what to set. All of them look at the configuration alone, so that
a mistake is told before a model is loaded; what shows only later is refused where it shows (`trainers.distributed`).
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING, Any, get_args

from agentspec.actions import suggest
from agentspec.llm.batching import Batching
from agentspec.reflection.retroformer import PATH
from agentspec.registry import REGISTRY, SpecError
from agentspec.spec import MODULE_KINDS
from trainers.estimators import ESTIMATORS, estimator
from trainers.fields import REFUSED, defaults, field_rules
from trainers.losses import LOSSES, loss
from trainers.sequences import TrainFilter, unmatched_patterns
from trainers.writes import write_credit

if TYPE_CHECKING:
    from trainers.config import ScaffoldConfig

TOKEN_MODES = ("token_truncate", "token_mask")
REFLECTION, REWARD = "retroformer", "reflection_gain"
REPORTERS = ("tensorboard", "wandb")
"""Where logs may go, each the name of the extra that installs it."""

NAMES: dict[str, Collection[str]] = {
    "estimator": ESTIMATORS,
    "normalize": ("token", "rollout"),
    "overlong": ("mask", "keep", "drop"),
    "overlong_ends": ("context", "budget", "max_steps", "truncated"),
    "train_credits": ("executed", "explored", "aux"),
    "memory_carry": ("first", "best"),
    "packing": ("tree", "padded"),
    "reference": ("initial", "base"),
    "batching": ("auto", *get_args(Batching)),
}
"""Field -> its alternatives, or those of each of its values."""

RANGES: dict[str, tuple[float, float]] = {
    "gamma": (0.0, 1.0),
    "top_entropy_quantile": (0.0, 1.0),
    "env_timeout_s": (0.001, math.inf),
    **dict.fromkeys(
        "gigpo_weight epsilon epsilon_high beta learning_rate actor_temperature tokens_per_forward "
        "rollout_concurrency retries lora_r lora_layers lora_alpha".split(),
        (0.0, math.inf),
    ),
    **dict.fromkeys(
        "max_completion_length num_iterations train_tasks validation_tasks write_rerolls write_points".split(),
        (1, math.inf),
    ),
}
"""Field -> smallest and largest value that means something: out of it, it would turn a sign around or be passed over."""


def check(config: ScaffoldConfig) -> None:
    """Refuse what cannot work, would not be exact, or would change nothing.

    Raises:
        SpecError: what was given, why it cannot work, what to do.
    """
    _ = config.reward_set, config.world, config.other_specs, config.starting_memory
    check_reporters(config)
    check_values(config)
    check_read(config)
    check_calls(config)
    check_writes(config)
    check_rounds(config)
    check_vllm(config)


def _refuse(*cases: tuple[Any, str]) -> None:
    """Refuse with the reason of the first case that holds."""
    for holds, why in cases:
        if holds:
            raise SpecError(why)


def check_given(names: Iterable[str], where: str) -> None:
    """Refuse fields that a user names and nobody reads, whatever their value.

    Args:
        names: keys of a YAML file, or options of a command line.
        where: what they were read from, for the message.
    """
    why = {name: reason for reason, listed in REFUSED.items() for name in listed.split()}
    for name in names:
        if name in why:
            raise SpecError(f"{where}: `{name}` is not read: {why[name]}")


def check_reporters(config: Any) -> None:
    """What logs are sent through is installed."""
    for name in [config.report_to] if isinstance(config.report_to, str) else config.report_to or []:
        if name in REPORTERS and importlib.util.find_spec(name) is None:
            raise SpecError(
                f"report_to names {name}, which is not installed; pip install 'agentspec-rl[{name}]', or set "
                "`report_to: none`"
            )


def check_values(config: ScaffoldConfig) -> None:
    """Every name is among its alternatives, every number means something."""
    for name, known in NAMES.items():
        value = getattr(config, name)
        for one in value if isinstance(value, (list, tuple)) else [value]:
            if one not in known:
                raise SpecError(f"unknown {name} {one!r}{suggest(one, known)}")
    for name, (low, high) in RANGES.items():
        value = getattr(config, name)
        if value is not None and not (low <= value <= high and math.isfinite(value)):
            most = "" if math.isinf(high) else f" and at most {high:g}"
            raise SpecError(f"{name} is {value}; expected a number of at least {low:g}{most}")


def check_read(config: ScaffoldConfig) -> None:
    """No field that nobody reads has a value of its own: of TRL's in no configuration, of the others in this one."""
    from trl import GRPOConfig

    for name, rule in field_rules(GRPOConfig).items():
        value = getattr(config, name, rule.allowed[0] if rule.allowed else None)
        if rule.status != "used" and value not in rule.allowed:
            verb = "is not read" if rule.status == "refused" else f"must be {rule.allowed[0]!r}"
            raise SpecError(f"{name} is {value!r}, and it {verb}: {rule.why}")
    default = defaults(type(config))
    for name, why in unread(config).items():
        if getattr(config, name) != default[name]:
            raise SpecError(f"{name} is {getattr(config, name)!r}, which changes nothing: {why}; or leave it out")


def unread(config: ScaffoldConfig) -> dict[str, str]:
    """Fields that this configuration does not read -> why not, and what would make it."""
    objective, writes, shape = loss(config.loss_type), write_credit(config.write_credit), "lora_alpha lora_targets"
    shape += " lora_layers"
    needs = estimator(config.estimator).needs
    vllm, colocated = config.use_vllm, config.use_vllm and config.vllm_mode == "colocate"
    readers = {n: ", ".join(e.name for e in ESTIMATORS.values() if n in e.needs) for n in ("gamma", "gigpo_weight")}
    constant = (
        "only loss_type 'dr_grpo' reads it, as its constant length; an answer's length is set under "
        "`agent: {sampling: {max_tokens: ...}}`"
    )
    rows: list[tuple[Any, str, str]] = [
        ("max_completion_length" in objective.uses, "max_completion_length", constant),
        ("delta" in objective.uses, "delta", f"loss_type {objective.name!r} does not read it"),
        ("epsilon" in objective.uses or not config.epsilon_high, "epsilon", f"{objective.name!r} reads epsilon_high"),
        (config.beta, "reference", "beta is 0; set it"),
        *((n in needs, n, f"estimator {config.estimator!r} does not read it; use {r}") for n, r in readers.items()),
        (writes.function, "write_calls", "write_credit is 'episode'; choose another"),
        ("write_rerolls" in writes.reads, "write_rerolls write_points", "set `write_credit: local`"),
        (not config.adapter, f"lora_r {shape}", "the adapter's own shape is trained; set `adapter: ''` for a new one"),
        (config.lora_r or config.adapter, shape, "lora_r 0 trains all weights; give it a rank"),
        (
            config.spec.reflection.name == REFLECTION,
            "actor_adapter actor_temperature",
            f"only beside a reflector that is trained (`reflection: {REFLECTION}`) acts a frozen actor",
        ),
        (config.spec.scope == "run", "memory_carry", "no memory outlives its episode; set `agent: {scope: run}`"),
        (config.validates, "validation_tasks validation_specs", "nothing is validated; set `eval_strategy: steps`"),
        (
            vllm,
            "vllm_mode vllm_batch_invariant vllm_importance_sampling_correction vllm_importance_sampling_mode "
            "vllm_importance_sampling_clip_max vllm_importance_sampling_clip_min",
            "set `use_vllm: true` (the local backend tries out by itself whether a device is batch-invariant)",
        ),
        (
            colocated,
            "vllm_model_impl vllm_enable_sleep_mode vllm_gpu_memory_utilization vllm_max_model_length "
            "vllm_tensor_parallel_size",
            "only a colocated vLLM reads it; give it to `vllm serve`, or set `vllm_mode: colocate`",
        ),
        (
            vllm and not colocated,
            "vllm_server_base_url vllm_server_host vllm_server_port vllm_server_timeout vllm_group_port",
            "set `use_vllm: true` and `vllm_mode: server`",
        ),
        (
            config.vllm_importance_sampling_correction,
            "vllm_importance_sampling_mode vllm_importance_sampling_clip_max vllm_importance_sampling_clip_min",
            "set `vllm_importance_sampling_correction: true`",
        ),
    ]
    return {name: why for read, names, why in rows if not read for name in names.split()}


def check_calls(config: ScaffoldConfig) -> None:
    """Something is trained, and sampled so that it can be."""
    spec, paths = config.spec, config.spec.call_paths()
    for name, train in (
        ("train_calls", config.train_filter),
        ("mask_truncated", TrainFilter((*config.mask_truncated,))),
    ):
        if missing := unmatched_patterns(paths, train):
            raise SpecError(
                f"{name} {missing} match no call of this scaffold, so nothing would come of them; its calls come from "
                f"{', '.join(sorted(set(paths))) or 'no module (none calls the model)'}"
            )
    temperatures = [("sampling.temperature", spec.sampling.temperature)]
    for kind in MODULE_KINDS:
        if why := REGISTRY.get(kind, getattr(spec, kind).name).declaration.untrainable:
            raise SpecError(
                f"agent.{kind} {getattr(spec, kind).name!r} cannot be trained through: {why}; train inside a method of "
                "this package, and evaluate with this one"
            )
        if any(config.train_filter.matches(p) for p in paths if p.startswith(f"{kind}.")):
            given = getattr(spec, kind).params.items()
            temperatures += [(f"{kind}.{n}", v) for n, v in given if n.endswith("temperature") and v is not None]
    for name, value in temperatures:
        if not 0 < value < math.inf:
            raise SpecError(
                f"agent.{name} is {value}, and calls sampled with it are trained (train_calls): greedy choices have no "
                "gradient, and an infinite temperature is no policy; set a number above 0"
            )
    _refuse(
        (
            "images" in spec.needs(),
            "agent.perception has images: true, and the policy that is trained reads text only (pictures have no token "
            "ids here); train without images, and evaluate models that see",
        ),
        (
            spec.sampling.top_p < 1 or spec.sampling.top_k > 0,
            "agent.sampling sets top_p or top_k: the update recomputes log-probabilities over the full distribution "
            "and would not match the sampled ones; train with top_p 1 and top_k 0",
        ),
        (
            config.adapter and config.lora_r == 0,
            f"adapter {config.adapter!r} with lora_r 0: all weights would be trained; merge it into a model",
        ),
    )


def own_memory_paths(config: ScaffoldConfig) -> list[str]:
    """Paths of the calls of memory that the policy answers, and no helper model."""
    agent = config.spec
    helped = {m for pattern in agent.roles for m in agent.helped(pattern)}
    return [p for p in agent.call_paths() if p.startswith("memory.") and p.partition("/")[0] not in helped]


def check_writes(config: ScaffoldConfig) -> None:
    """Estimators of a write have writes to credit."""
    spec, roles = write_credit(config.write_credit), config.spec.roles
    if spec.function is None:
        return
    paths, writes = own_memory_paths(config), TrainFilter(tuple(config.write_calls))
    _refuse(
        (
            roles and spec.reads,
            f"write_credit {spec.name!r} with roles {list(roles)}: an episode is played again from its recorded "
            "answers, and those of helper models are not given back; use `write_credit: ablation`, or no helper",
        ),
        (
            not any(config.train_filter.matches(p) and writes.matches(p) for p in paths),
            f"write_credit {spec.name!r}, but no call of memory {config.spec.memory.name!r} is both trained "
            f"(train_calls {config.train_calls}) and a write (write_calls {config.write_calls}); its calls are "
            f"{', '.join(paths) or 'none that the policy answers'}; add 'memory.*' to train_calls",
        ),
    )


def check_rounds(config: ScaffoldConfig) -> None:
    """Groups can be compared, an update reads one generation round (whole or in equal parts), the best has a file."""
    accumulated, made = config.gradient_accumulation_steps, config.steps_per_generation
    tasks = (config.generation_batch_size or 0) // config.num_generations
    saves = getattr(config.save_strategy, "value", config.save_strategy)
    stepwise = config.validates and saves == "steps" and config.eval_strategy == "steps"
    _refuse(
        (
            config.num_generations < 2,
            f"num_generations is {config.num_generations}: a group needs at least 2 rollouts to compare",
        ),
        (
            made % accumulated,
            f"gradient_accumulation_steps {accumulated} with steps_per_generation {made}: an update would mix "
            f"generation rounds, each with a denominator of its own; set steps_per_generation to {accumulated} (the "
            "same rollouts in one round), or to a multiple of it (several updates a round)",
        ),
        (
            config.train_tasks < tasks,
            f"train_tasks is {config.train_tasks}, and a generation round takes {tasks} different tasks "
            f"({config.generation_batch_size} rollouts in groups of {config.num_generations}): not one round could be "
            f"played; set train_tasks to at least {tasks}, or lower gradient_accumulation_steps",
        ),
        (
            stepwise and (config.eval_steps or 0) % config.save_steps,
            f"eval_steps {config.eval_steps} is no multiple of save_steps {config.save_steps}, so the best update may "
            "have no checkpoint; make it one, or set `save_strategy: best`",
        ),
        (
            config.normalize == "rollout" and not loss(config.loss_type).per_token,
            f"normalize 'rollout' with loss_type {config.loss_type!r}: its denominator is not the number of trained "
            f"tokens; use one of {', '.join(name for name, s in LOSSES.items() if s.per_token)}",
        ),
    )


def check_vllm(config: ScaffoldConfig) -> None:
    """Nothing that TRL offers for whole rows, or for all ranks at once."""
    if not config.use_vllm:
        return
    colocated, mode = config.vllm_mode == "colocate", config.vllm_importance_sampling_mode
    _refuse(
        (
            config.vllm_batch_invariant and not colocated,
            f"vllm_batch_invariant is true with vllm_mode {config.vllm_mode}: a server's arithmetic is set where it is "
            "started, and cannot be seen from here; start it as `VLLM_BATCH_INVARIANT=1 vllm serve ...` and leave the "
            "field out",
        ),
        (
            colocated and config.vllm_tensor_parallel_size != 1,
            f"vllm_tensor_parallel_size is {config.vllm_tensor_parallel_size} with vllm_mode colocate: its engine "
            "needs the same requests at the same moment on several processes, but each plays episodes of its own; use "
            "1, or vllm_mode: server (`vllm serve --tensor-parallel-size ...`)",
        ),
        (
            config.vllm_importance_sampling_correction and mode not in TOKEN_MODES,
            f"vllm_importance_sampling_mode {mode!r} speaks of rows, and an episode may have several; use one of "
            f"{', '.join(TOKEN_MODES)}",
        ),
    )


def check_retroformer(config: ScaffoldConfig) -> None:
    """Refuse what does not train a reflector beside a frozen actor."""
    reflection, scope = config.spec.reflection, config.spec.scope
    played = config.per_device_train_batch_size * config.steps_per_generation
    _refuse(
        (
            reflection.name != REFLECTION,
            f"the reflector is trained in `reflection: {REFLECTION}`; the agent has {reflection.name!r}",
        ),
        (
            reflection.params.get("when") != "start" or scope != "run",
            "a lesson and the trial that pays it must be one episode that starts from the failed trial's memory: set "
            f"`reflection: {{name: {REFLECTION}, when: start}}` and `scope: run`",
        ),
        (
            reflection.params.get("control"),
            "reflection.control: a fixed text stands for every lesson, so none is sampled; leave it out",
        ),
        (
            reflection.params.get("temperature") == 0,
            "reflection.temperature is 0: all lessons of a group would be the same; set it above 0",
        ),
        (config.start_memory, "start_memory: lessons are about first trials, which start from nothing; leave it out"),
        (
            config.train_calls != [PATH],
            f"train_calls {config.train_calls}: the actor is frozen; only [{PATH!r}] is trained",
        ),
        (
            REWARD not in config.reward_set.weights,
            f"rewards {config.rewards}: a lesson is paid the change of return; give {REWARD!r} a weight",
        ),
        (
            config.write_credit != "episode",
            f"write_credit {config.write_credit!r}: only the lesson is trained, no write of a memory",
        ),
        (
            config.lora_r == 0,
            "lora_r is 0: all weights would be trained, the actor's among them; give the reflector a rank",
        ),
        (
            config.use_vllm,
            "use_vllm: the engine holds one set of weights, with the trained adapter merged in; actor and reflector "
            "differ. Use the local backend (use_vllm: false)",
        ),
        (
            played % config.num_generations,
            f"{played} rollouts per process are no whole groups of {config.num_generations}: lessons about one failed "
            "trial are written where it was played",
        ),
    )


def notes(config: ScaffoldConfig) -> list[str]:
    """What a user should know about a configuration that runs."""
    spec = loss(config.loss_type)
    cap = config.epsilon if config.epsilon_high is None else config.epsilon_high
    memory = [p for p in config.spec.call_paths() if p.startswith("memory.") and config.train_filter.matches(p)]
    unpaid = "aux" not in config.train_credits and config.spec.memory.name != "summary"
    found = (
        (
            spec.depends_on_rows,
            f"loss_type {spec.name}: {spec.depends_on_rows}; 'dapo' does not depend on rows",
        ),
        (
            spec.name == "cispo" and cap < 1,
            f"loss_type cispo: epsilon_high {cap:g} is a bound of the ratio itself, so every token near its ratio of 1 "
            f"is capped and its gradient is {cap:g} of the policy gradient; its authors' bound is 5",
        ),
        (
            memory and unpaid,
            f"train_calls match {', '.join(memory)}, and train_credits {config.train_credits} lack 'aux': what a "
            "memory asks is help unless it says otherwise, so nothing of it is trained",
        ),
        (
            config.top_entropy_quantile < 1,
            "top_entropy_quantile: the quantile is of each micro-batch, so it depends on how rows are split",
        ),
    )
    return [text for holds, text in found if holds]
