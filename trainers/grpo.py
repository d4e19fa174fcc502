"""GRPO inside the scaffold: TRL's trainer, fed by episodes.

TRL keeps what it is good at: configuration, rewards and their logs, the clipped losses, PEFT, accelerate, checkpoints.
This subclass replaces where rows come from. For each generation batch it runs one episode per task row, lets TRL see
one stand-in row per episode so that rewards, groups and logs stay its own, and then puts all sequences of all episodes
in their place: advantages per episode, a fixed number of micro-batches, the denominator counted over what is trained.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from accelerate.utils import gather_object
from torch import nn
from trl import GRPOTrainer

from agentspec.carry import FILE as MEMORY_FILE
from agentspec.carry import MemoryBank, save_bank
from agentspec.episode import Job, MakeEnv, Runner, make_env
from agentspec.llm.base import LLM
from agentspec.metrics import figures
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from trainers.audit import receipt_rows
from trainers.batches import ROWS, Row, blank_row, collate, deal, rows_logprobs
from trainers.call_metrics import CallMetrics, clipped_tokens, truncated_calls
from trainers.config import ScaffoldConfig
from trainers.credit import CreditRule, ScoredEpisode
from trainers.distributed import KnownLayout, check_trained
from trainers.resume import ExactResume, last_complete_checkpoint, restore_finished, rewind_logs, set_aside
from trainers.rollouts import collect, rollout_jobs, starting_states, task_of
from trainers.runlog import RunLog, transcript
from trainers.tree import enable_tree
from trainers.validation import validate, validation_scaffolds
from trainers.vllm import importance_ratio, vllm_round


class ScaffoldGRPOTrainer(KnownLayout, ExactResume, GRPOTrainer):
    """GRPO whose rollouts are episodes of an agent.

    Args:
        model: the policy, already loaded (a ``PeftModel`` or any causal LM).
        args: see :class:`~trainers.config.ScaffoldConfig`.
        train_dataset: rows of :func:`~trainers.rollouts.task_rows`.
        make_llm: model, tokenizer -> the backend that samples from the live policy (default: the local one).
        make_env: task -> environment.
        kwargs: passed on to ``trl.GRPOTrainer``.
    """

    def __init__(
        self,
        model: nn.Module,
        args: ScaffoldConfig,
        *,
        make_llm: Callable[[nn.Module, Any], LLM] | None = None,
        make_env: MakeEnv = make_env,
        **kwargs: Any,
    ) -> None:
        args.check()
        self.rewards_used = args.reward_set
        self.credit_rule = CreditRule.from_config(args)
        self._played: list[ScoredEpisode] = []
        self._current: dict[str, Any] | None = None
        self._buffered_inputs: Any = None
        self._last_loaded_step = -1
        super().__init__(
            model=model,
            args=args,
            reward_funcs=[self._reward_function(name) for name in self.rewards_used.weights],
            **kwargs,
        )
        self.reward_weights = torch.tensor(list(self.rewards_used.weights.values()), dtype=torch.float32)
        if args.packing == "tree":
            for policy in filter(None, (self.model, self.ref_model)):
                enable_tree(self.accelerator.unwrap_model(policy))
        self._packing: dict[str, Any] = {"packing": args.packing, "tokens_per_forward": args.tokens_per_forward}
        self.run_log = RunLog(args.output_dir)
        self._make_env = make_env
        self._make_llm = make_llm or partial(local_llm, batching=args.batching)
        self._llm: LLM | None = None
        self._round = 0
        self._memory: bytes | None = args.starting_memory
        self._call_metrics = CallMetrics()

    def train(self, resume_from_checkpoint: str | bool | None = None, **kwargs: Any) -> Any:
        """As TRL's; first writes the run's manifest (configuration, scaffold, versions, command).

        ``resume_from_checkpoint=True`` means the last complete checkpoint in ``output_dir``, if there is one.
        """
        if resume_from_checkpoint is True:
            resume_from_checkpoint = str(last_complete_checkpoint(self.args.output_dir) or "")
        if self.accelerator.is_main_process:
            if not resume_from_checkpoint:
                set_aside(self.args.output_dir)
            config, spec = self.args.to_dict(), self.args.spec.to_data()
            self.run_log.manifest(config=config, spec=spec, resumed_from=str(resume_from_checkpoint or ""))
            if not resume_from_checkpoint:
                rewind_logs(self.run_log, 0)  # of a run that ended before its first checkpoint, say
        finished = restore_finished(self, resume_from_checkpoint) if resume_from_checkpoint else None
        finished = finished or super().train(resume_from_checkpoint=resume_from_checkpoint or None, **kwargs)
        self._last_loaded_step = -1  # the weights may now be those of the best checkpoint
        return finished

    @property
    def last_episodes(self) -> list[Trajectory]:
        """This rank's episodes of the last generation round."""
        return [e.trajectory for e in self._played]

    # --- rollouts ----------------------------------------------------------------------------------------------------

    @property
    def llm(self) -> LLM:
        """The backend that samples from the live policy."""
        if self._llm is None and self.use_vllm:
            from agentspec.llm.vllm import trl_backend

            self._llm = trl_backend(self.vllm_generation, self.processing_class)
        if self._llm is None:
            self._llm = self._make_llm(self.accelerator.unwrap_model(self.model), self.processing_class)
        return self._llm

    def _reward_function(self, name: str) -> Callable[..., list[float | None]]:
        """A TRL reward function that reads the finished episodes."""

        def reward(**_: Any) -> list[float | None]:
            return [None if e.score is None else e.score.sums[name] for e in self._played]

        reward.__name__ = name
        return reward

    def _generate(self, prompts: list[Any]) -> tuple[Any, ...]:
        """One stand-in row per episode for TRL; the episodes themselves are kept aside.

        Returns TRL's tuple: prompt ids, completion ids, tool mask, completions, log-probs, extra fields, images, tool
        images.
        """
        rows = self._task_rows
        jobs = rollout_jobs(
            rows,
            seed=self.args.seed,
            round=self._round,
            first=self.accelerator.process_index * len(rows),
            group=self.num_generations,
            memory=self._memory,
        )
        with self._current_weights():
            self._played = self._play(jobs)
        self._log_episodes()
        self._memory = self._carried_memory()
        stand_in = [self._tokenizer.pad_token_id]
        completions = [[{"role": "assistant", "content": transcript(t)}] for t in self.last_episodes]
        n = len(completions)
        return [stand_in] * n, [stand_in] * n, [[0]] * n, completions, None, {}, None, []

    def _runner(self, spec: AgentSpec) -> Runner:
        """Runs episodes of ``spec`` with the policy as it is."""
        return Runner(
            spec,
            self.llm,
            make_env=self._make_env,
            concurrency=self.args.rollout_concurrency or None,
            timeout_s=self.args.env_timeout_s,
            policy=f"step-{self.state.global_step}",
        )

    def _play(self, jobs: Sequence[Job], spec: AgentSpec | None = None) -> list[ScoredEpisode]:
        """One episode per job, in order, those that failed among them; ``spec``: another than the training scaffold."""
        runner = self._runner(spec or self.args.spec)
        return collect(runner, jobs, self.rewards_used, retries=self.args.retries)

    @contextmanager
    def _current_weights(self) -> Iterator[None]:
        """Inside this block the backend samples from the weights as they are now."""
        if self.use_vllm:
            stale = self.state.global_step != self._last_loaded_step
            self._last_loaded_step = self.state.global_step
            with vllm_round(self.vllm_generation, stale=stale):
                yield
            return
        invalidate = getattr(self.llm, "invalidate", None)
        if invalidate is not None:
            invalidate()
        yield

    def _generate_and_score_completions(self, inputs: list[dict[str, Any]]) -> dict[str, Any]:
        self._task_rows = inputs
        self.vllm_importance_sampling_correction = False  # of the rows, not of TRL's stand-ins for episodes
        try:
            super()._generate_and_score_completions(inputs)  # rewards, their logs, and TRL's metrics
        finally:
            self.vllm_importance_sampling_correction = self.args.vllm_importance_sampling_correction
        return {ROWS: self._rows()}

    def _rows(self) -> list[Row]:
        """All sequences of this rank's episodes with the advantages of the whole group."""
        credited = self.credit_rule.credit(self._played, rank=self.accelerator.process_index, gather=gather_object)
        cut = truncated_calls(self.last_episodes, self.credit_rule.train)
        for name, value in (credited.metrics | cut).items():
            self._metrics["train"][name].append(value)
        self._check_trained()
        return credited.rows

    def _check_trained(self) -> None:
        """Refuse a generation batch that trains nothing, on all ranks together."""
        check_trained(self.last_episodes, self.args, gather_object)

    def _carried_memory(self) -> bytes | None:
        """With ``scope: run``: the bank of memories that the next round starts from, the same on every rank.

        Each task carries the memory of one of its own rollouts. The main process keeps the bank as ``memory.json``.
        """
        if self.args.spec.scope != "run":
            return None
        bank = MemoryBank.of_spec(self.args.spec) if self._memory is None else MemoryBank.load(self._memory)
        played = [(e.trajectory.task.key, e.total, e.trajectory.memory_state) for e in self._played]
        bank = bank.carried(gather_object(played), self.args.memory_carry)
        if self.accelerator.is_main_process:
            save_bank(self.run_log.folder / MEMORY_FILE, bank)
        return bank.dump()

    # --- updates -----------------------------------------------------------------------------------------------------

    def _prepare_inputs(self, generation_batch: Any) -> dict[str, Any]:
        """The next micro-batch; a new generation round when the buffered ones are used up."""
        if self._step % self._steps_per_round == 0 or self._buffered_inputs is None:
            self._round = self.state.global_step
            rows = self._generate_and_score_completions(generation_batch)[ROWS]
            self._buffered_inputs = self._micro_batches(rows, self.args.steps_per_generation)
            self._log_update(rows)
        batch: dict[str, Any] = self._buffered_inputs[self._step % self.args.steps_per_generation]
        return batch

    @property
    def _steps_per_round(self) -> int:
        """Micro-batches between two generation rounds."""
        return int(self.args.steps_per_generation * self.num_iterations)

    @property
    def _skip_silent(self) -> bool:
        """Rows with advantage 0 have no gradient unless a KL or entropy term gives them one."""
        return self.beta == 0.0 and not self._entropy_bonus_enabled

    def _micro_batches(self, rows: Sequence[Row], count: int) -> list[dict[str, Any]]:
        """Deal rows into ``count`` micro-batches; every rank gets the same shape of deal."""
        device = self.accelerator.device
        sizes = self.accelerator.gather(torch.tensor([-(-max(1, len(rows)) // count)], device=device))
        blank = blank_row(self._tokenizer.pad_token_id)
        together = self.args.packing == "tree"
        return self._collated(deal(rows, count, blank=blank, rows_per_hand=int(sizes.max()), together=together))

    def _collated(self, hands: Sequence[Sequence[Row]]) -> list[dict[str, Any]]:
        """What TRL's loss reads of each micro-batch; the denominator counts every trained token of all ranks."""
        device = self.accelerator.device
        trained = torch.tensor(sum(r.sequence.trained for hand in hands for r in hand), device=device)
        total = self.accelerator.gather(trained).sum()
        batches = []
        for hand in hands:
            batch: dict[str, Any] = collate(hand, self._tokenizer.pad_token_id, device, skip_silent=self._skip_silent)
            batch |= {ROWS: hand, "num_items_in_batch": total}
            if self._off_policy:
                batch["old_per_token_logps"] = batch["sampled_logprobs"]
            if self.beta != 0.0:
                batch["ref_per_token_logps"] = self._reference_logprobs(hand)
            batches.append(batch)
        return batches

    @property
    def _off_policy(self) -> bool:
        """Whether an update may see weights other than those that sampled (then the recorded log-probs are the old)."""
        return bool(self.args.gradient_accumulation_steps % self._steps_per_round != 0)

    def _reference_logprobs(self, rows: Sequence[Row]) -> torch.Tensor:
        """Log-probabilities under the reference: a model of its own, or the base under the adapter."""
        with torch.no_grad():
            if self.ref_model is not None:
                return rows_logprobs(self.ref_model, rows, **self._packing)[0]
            model = self.accelerator.unwrap_model(self.model)
            from trl.trainer.utils import use_adapter

            with use_adapter(model, adapter_name="ref" if "ref" in model.peft_config else None):
                return rows_logprobs(model, rows, **self._packing)[0]

    def _compute_loss(self, model: nn.Module, inputs: dict[str, Any]) -> torch.Tensor:
        self._current = inputs
        try:
            loss: torch.Tensor = super()._compute_loss(model, inputs)
            return loss
        finally:
            self._current = None

    def _get_per_token_logps_and_entropies(self, model: nn.Module, *args: Any, **kwargs: Any) -> Any:
        """Log-probabilities of the micro-batch's rows under the distributions they were sampled from.

        TRL also calls this for its stand-in rows, which have none of ours: those go to TRL's own implementation.
        """
        inputs = getattr(self, "_current", None)
        if inputs is None:
            return super()._get_per_token_logps_and_entropies(model, *args, **kwargs)
        with self.accelerator.autocast():
            logps, entropies = rows_logprobs(model, inputs[ROWS], skip_silent=self._skip_silent, **self._packing)
        computed = inputs["tool_mask"]
        difference = (logps.detach() - inputs["sampled_logprobs"]).abs() * computed
        self._metrics["train"]["sampling/logp_difference_max"].append(difference.max().item())
        old = inputs.get("old_per_token_logps", logps).detach()
        limits = self.loss_type, self.epsilon_low, self.epsilon_high
        clipped = clipped_tokens((logps.detach() - old).exp(), inputs["advantages"], *limits)
        self._call_metrics.add(inputs[ROWS], entropies, clipped, computed)
        if self.use_vllm and self.vllm_importance_sampling_correction:
            # Where the recorded log-probabilities are the old ones, the ratio starts from what vLLM sampled already.
            current = old if "old_per_token_logps" in inputs else logps
            bounds = self.vllm_importance_sampling_clip_min, self.vllm_importance_sampling_clip_max
            inputs["importance_sampling_ratio"] = importance_ratio(
                current, inputs["sampled_logprobs"], computed, self.vllm_importance_sampling_mode, *bounds
            )
        return logps, entropies, None

    # --- logs --------------------------------------------------------------------------------------------------------

    def _log_episodes(self) -> None:
        """Scaffold metrics of this rank's episodes, and the trajectories themselves."""
        scored = [figures(t) for t in self.last_episodes if t.scorable]
        for name in dict.fromkeys(name for row in scored for name in row):
            values = [row[name] for row in scored if name in row]
            self._metrics["train"][f"episode/{name}"].append(sum(values) / len(values))
        self.run_log.trajectories(self._round, self.accelerator.process_index, self.last_episodes)

    def _log_update(self, rows: Sequence[Row]) -> None:
        """The receipt of a generation round: what every rank contributed, written by the main process."""
        first = self.accelerator.process_index * len(self._played)
        receipts = [{**r, "episode": first + r["episode"]} for r in receipt_rows(rows)]
        blank = sum(r.episode < 0 for batch in self._buffered_inputs for r in batch[ROWS])
        played = gather_object([(e.trajectory.episode, e.total) for e in self._played])
        receipt = {
            "round": self._round,
            "episodes": [name for name, _ in played],
            "returns": [value for _, value in played],
            "rows": gather_object(receipts),
            "blank_rows": sum(gather_object([blank])),
            "denominator": int(self._buffered_inputs[0]["num_items_in_batch"]),
            "estimator": self.args.estimator,
            "loss_type": self.loss_type,
        }
        if self.accelerator.is_main_process:
            self.run_log.append("updates.jsonl", receipt)

    def log(self, logs: dict[str, float], start_time: float | None = None) -> None:
        summary = "train_runtime" in logs  # of a whole (part of a) run, not of an update
        if self.model.training and not summary:
            logs |= self._call_metrics.flush(gather_object)
        super().log(logs, start_time)
        if self.accelerator.is_main_process and not summary:
            step, name = self.state.global_step, "metrics.jsonl" if self.model.training else "evaluations.jsonl"
            if not self.model.training:
                self.run_log.rewind(name, "step", step - 1)  # a resumed run may evaluate its checkpoint again
            self.run_log.append(name, {"step": step, **logs})

    def evaluate(
        self, eval_dataset: Any = None, ignore_keys: Any = None, metric_key_prefix: str = "eval"
    ) -> dict[str, float]:
        """Play the validation tasks with the policy as it is; see :mod:`trainers.validation`.

        The trainer's random states, its buffers and the run's memory stay as they are: training goes on as if nothing
        had been evaluated.

        Args:
            eval_dataset: rows of :func:`~trainers.rollouts.task_rows`; default: the trainer's ``eval_dataset``.
            ignore_keys: not used (part of the base class's signature).
            metric_key_prefix: stands before every metric's name.
        """
        rows = self.eval_dataset if eval_dataset is None else eval_dataset
        tasks = [task_of(row) for row in rows]
        states = starting_states(tasks, self._memory, unseen=True)
        training = self.model.training
        self.model.eval()
        with self._current_weights():
            metrics = validate(
                validation_scaffolds(self.args),
                [Job(t, 0, self.args.seed, s) for t, s in zip(tasks, states, strict=True)],
                lambda spec, jobs: self._play(jobs, spec),
                rank=self.accelerator.process_index,
                ranks=self.accelerator.num_processes,
                gather=gather_object,
            )
        metrics = {f"{metric_key_prefix}_{name}": value for name, value in metrics.items()}
        self.log(dict(metrics))
        control = self.callback_handler.on_evaluate(self.args, self.state, self.control, metrics)  # type: ignore[has-type]
        self.control = control
        self.model.train(training)
        return metrics


def local_llm(model: nn.Module, tokenizer: Any, batching: Any = "auto") -> LLM:
    """The local backend over the live policy."""
    from agentspec.llm.local import LocalLLM

    return LocalLLM(model, tokenizer, name="policy", batching=batching)
