"""The configuration of a run: TRL's `GRPOConfig` plus what the scaffold adds, in one dataclass.

`trainers.arguments` fills it from a YAML file and from the command line, and its docstring is what `--help` says of
each field. What cannot work or would not be exact is refused at start (`trainers.checks`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from trl import GRPOConfig

from agentspec.carry import start_bank
from agentspec.llm.models import base_of
from agentspec.mixture import mixture
from agentspec.parameters import check_types
from agentspec.records.chain import steps_per_round
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from rewards import RewardSet
from trainers.ahead import OURS, STRUCTURES, check_world, structure
from trainers.checks import check
from trainers.credit import CreditRule
from trainers.fields import USED
from trainers.sequences import TrainFilter

CHECKPOINTING = (
    "activation_checkpointing" if hasattr(GRPOConfig, "activation_checkpointing") else "gradient_checkpointing"
)
"""What the installed transformers calls recomputing activations; it warns of the older name."""

LISTS = ("train_calls", "train_credits", "mask_truncated", "write_calls", "overlong_ends", "lora_targets")
"""Lists of texts: one text alone is a list of one."""


@dataclass
class ScaffoldConfig(GRPOConfig):
    """`trl.GRPOConfig` and what training inside a scaffold needs.

    Args:
        model: what `agentspec.llm.models.resolve` understands: a folder, `smollm2-135m` or a hub id.
        adapter: PEFT folder to start from (a warm start), or empty.
        actor_adapter: training a reflector: PEFT folder of the frozen actor, or empty (the base model acts).
        actor_temperature: training a reflector: sampling temperature of the actor; lessons have the agent's.
        agent: the agent spec: a mapping, or a path to a YAML file.
        environment: `{name: ..., options: {...}}`: the world and its `gymnasium.make` arguments.
        scaffolds: several agents instead of one: entries over `agent`, with lists of alternatives
            (`agentspec.mixture`). A warm start plays its expert through all of them.
        scaffold_groups: in training with `scaffolds`: rollouts of a group are dealt out `across` them, or each group is
            played `within` one (that of its task's seed).
        held_out: agents that must not be among `scaffolds`, by what they name.
        train_tasks: number of distinct training tasks (seeds `0 .. train_tasks - 1`).
        eval_tasks: number of held-out tasks (seeds `20000 ..`) for evaluation after training.
        train_calls: patterns over `module/purpose` of the calls that are trained.
        train_credits: credits that are trained (`executed`, `explored`, `aux`).
        rewards: weight by registered reward; default `{earning_delta: 1.0}`.
        reference: with `beta` above 0, what the policy is kept near: the `initial` policy (its adapter included), or
            the `base` model without any adapter.
        estimator: how returns become advantages: a name in `trainers.estimators.ESTIMATORS`.
        gamma: discount per step of the step-level estimators.
        gigpo_weight: weight of the step advantage in `gigpo`.
        skip_zero_variance: leave groups to which the estimator gives no advantage out of the denominator too.
        normalize: what weighs the same: every trained `token`, or every `rollout` however many it trains.
        overlong: what happens to episodes that ended for a reason in `overlong_ends`: `mask` (zero loss, still in
            the baseline: SUPO's default), `keep` or `drop` (neither loss nor baseline).
        overlong_ends: ends that make an episode overlong: `context`, `budget`, `max_steps`, `truncated`.
        mask_truncated: patterns of calls whose completions are not trained when they hit their length limit.
        memory_carry: with `scope: run`, whose memory a task carries on: that of its `first` rollout, or its `best`.
        start_memory: with `scope: run`, a memory file or the folder of a run that wrote one (`memory.json`), to start
            from; empty: every task starts with an empty memory.
        write_credit: what trained calls of memory earn: what the `episode` does, `local` re-rolls with and without the
            write, or the `ablation` of the whole memory (`trainers.writes.WRITE_CREDITS`).
        write_calls: patterns of the calls that write (those of memory; narrow it to leave out what only recalls).
        write_rerolls: with `local`: re-rolls with, and as many without, each write that is looked at.
        write_points: with `local`: most writes of an episode that are looked at; the others earn 0.
        retries: how often a failed episode (environment or model error) is run again before it is unscorable.
        env_timeout_s: limit of one environment call, in seconds.
        rollout_concurrency: most episodes at once (0: all of a generation batch).
        batching: when the local backend takes requests into a running batch: `continuous` at any time, `closed` never;
            `auto` is `continuous` where runs repeat to the last bit with it (`agentspec.llm.batching`).
        packing: `tree` computes shared prefixes of the update once, `padded` computes every row; gradients agree.
        tokens_per_forward: token budget of one forward of the update (0: the whole micro-batch for a tree, row by row
            for padded rows); chunks beyond one are recomputed backward, which bounds memory.
        lora_r: rank of a new LoRA adapter; 0 trains all weights.
        lora_alpha: scale of the adapter (0: twice the rank).
        lora_targets: module names that carry LoRA (`all-linear` or a list).
        lora_layers: number of top layers that carry LoRA (0: all); fewer layers, shorter backward pass, less memory.
        vllm_importance_sampling_mode: the importance ratio of a token that vLLM sampled: clipped at
            `vllm_importance_sampling_clip_max` (`token_truncate`) or 0 beyond it (`token_mask`).
        vllm_batch_invariant: run the colocated vLLM in its batch-invariant mode (`VLLM_BATCH_INVARIANT=1`), so that
            runs repeat however requests meet; NVIDIA GPUs of compute capability 8.0 and above.
        eval_specs: agent specs to evaluate under after training: mappings or paths.
        eval_sampling: sampling overrides at evaluation (default: greedy).
        validation_tasks: number of held-out tasks (seeds `10000 ..`) that are played every `eval_steps` updates with
            `eval_strategy: steps`; the best checkpoint by `metric_for_best_model` (default `reward`) is kept.
        validation_specs: further agent specs to validate under, beside the training scaffold.
        plots: write the reward curve as PNG when training ends.
        resume: continue from the last checkpoint in `output_dir`.
    """

    model: str = "smollm2-135m"
    adapter: str = ""
    actor_adapter: str = ""
    actor_temperature: float = 0.0
    agent: dict[str, Any] | str | None = None
    environment: dict[str, Any] | str | None = None
    scaffolds: list[Any] | str | None = None
    held_out: list[Any] | str | None = None
    scaffold_groups: str = "across"
    train_tasks: int = 64
    eval_tasks: int = 16
    train_calls: list[str] = field(default_factory=lambda: ["reasoning.*"])
    train_credits: list[str] = field(default_factory=lambda: ["executed"])
    rewards: dict[str, float] | str | None = None
    estimator: str = "grpo"
    reference: str = "initial"
    gamma: float = 1.0
    gigpo_weight: float = 1.0
    skip_zero_variance: bool = False
    normalize: str = "token"
    overlong: str = "mask"
    overlong_ends: list[str] = field(default_factory=lambda: ["context"])
    mask_truncated: list[str] = field(default_factory=list)
    memory_carry: str = "first"
    start_memory: str = ""
    write_credit: str = "episode"
    write_calls: list[str] = field(default_factory=lambda: ["memory.*"])
    write_rerolls: int = 2
    write_points: int = 1
    retries: int = 0
    env_timeout_s: float = 60.0
    rollout_concurrency: int = 0
    batching: str = "auto"
    packing: str = "tree"
    tokens_per_forward: int = 0
    lora_r: int = 16
    lora_alpha: int = 0
    lora_targets: list[str] = field(default_factory=lambda: ["all-linear"])
    lora_layers: int = 0
    vllm_importance_sampling_mode: str = "token_truncate"  # TRL's default is a ratio of whole rows
    vllm_batch_invariant: bool = False
    eval_specs: list[Any] | str | None = None
    eval_sampling: dict[str, Any] | str | None = None
    validation_tasks: int = 16
    validation_specs: list[Any] | str | None = None
    plots: bool = True
    resume: bool = False

    def __post_init__(self) -> None:
        for name in STRUCTURES:
            setattr(self, name, structure(getattr(self, name)))
        for name in LISTS:
            setattr(self, name, [given] if isinstance(given := getattr(self, name), str) else given)
        check_types("configuration", type(self), _given(self))
        if self.validates:
            self.metric_for_best_model = getattr(self, "metric_for_best_model", None) or "reward"
            self.num_generations_eval = 1  # TRL's rows per task: validation plays each task once
        if getattr(self, "bf16", None) is None and self.use_cpu:
            self.bf16 = False  # TRL's default would round log-probabilities to 16 bits, and is slower on a CPU
        if hasattr(self, CHECKPOINTING) and getattr(self, CHECKPOINTING) is None:
            setattr(self, CHECKPOINTING, self.gradient_checkpointing)  # the same setting under its newer name
        try:
            super().__post_init__()
        except (TypeError, AttributeError, ImportError) as error:  # of a mapping that TRL passes on: `deepspeed`, say
            raise SpecError(f"configuration: {error}") from error

    @property
    def spec(self) -> AgentSpec:
        """The training scaffold."""
        return agent_spec(self.agent).with_base(base_of(self.model))

    @property
    def mixture(self) -> list[AgentSpec]:
        """The training scaffolds: `spec`, or those of `scaffolds`."""
        return [self.spec] if self.scaffolds is None else mixture(self.spec.to_data(), self.scaffolds, self.held_out)

    @property
    def credit_rule(self) -> CreditRule:
        """How episodes are credited."""
        return CreditRule.from_manifest(vars(self))

    @property
    def train_filter(self) -> TrainFilter:
        """Which completions are trained."""
        return self.credit_rule.train

    @property
    def world(self) -> tuple[str, dict[str, Any]]:
        """Name and options of the environment; `SpecError` where there is no such."""
        return check_world(self.environment or "deliverybench")

    @property
    def rounds(self) -> int:
        """Generation rounds of the run: of its `max_steps` or, without them, of its passes over the tasks."""
        if self.max_steps > 0:
            return math.ceil(self.max_steps / steps_per_round(vars(self)))
        groups = (self.generation_batch_size or 0) // self.num_generations
        return math.ceil(self.num_train_epochs * (self.train_tasks // groups))

    @property
    def validates(self) -> bool:
        """Whether held-out tasks are played while training."""
        return getattr(self.eval_strategy, "value", self.eval_strategy) != "no" or bool(self.eval_on_start)

    @property
    def evaluation_specs(self) -> list[AgentSpec]:
        """Agent specs to evaluate under after training: the training scaffold if none are named."""
        return [self.spec] if self.eval_specs is None else [agent_spec(s) for s in _listed(self.eval_specs)]

    @property
    def other_specs(self) -> list[AgentSpec]:
        """Agent specs to validate under, beside the training scaffold."""
        return [agent_spec(s).with_base(base_of(self.model)) for s in _listed(self.validation_specs or [])]

    @property
    def evaluation_sampling(self) -> dict[str, Any]:
        """Sampling overrides at evaluation; greedy unless the config says otherwise."""
        return {"temperature": 0.0} if self.eval_sampling is None else dict(self.eval_sampling)  # type: ignore[arg-type]

    @property
    def reward_set(self) -> RewardSet:
        """The weighted rewards."""
        return RewardSet(self.credit_rule.rewards)

    @property
    def starting_memory(self) -> bytes | None:
        """The bank of memories that the run starts from (`agentspec.carry`), or `None` where it starts from nothing.

        Raises:
            SpecError: no such file, or one of other modules than the agent's.
        """
        return start_bank(self.start_memory, self.spec).dump() if self.start_memory else None

    def check(self) -> None:
        """See `trainers.checks.check`."""
        check(self)


def agent_spec(value: Any) -> AgentSpec:
    """A spec from a mapping, a YAML path, or nothing (all defaults)."""
    return AgentSpec.from_yaml(value) if isinstance(value, str) else AgentSpec.from_data({} if value is None else value)


def _listed(specs: list[Any] | str) -> list[Any]:
    return [specs] if isinstance(specs, str) else list(specs)


def _given(config: ScaffoldConfig) -> dict[str, Any]:
    """The fields that are read and their values; TRL's own are `None` where their parser leaves them out."""
    inherited = {n: getattr(config, n, None) for names in USED.values() for n in names.split()}
    ours = {n: getattr(config, n) for names in OURS.values() for n in names.split()}
    return {name: value for name, value in inherited.items() if value is not None} | ours
