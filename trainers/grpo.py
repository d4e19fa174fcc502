"""GRPO inside the scaffold: TRL's trainer, fed by episodes.

TRL keeps what it is good at: configuration, rewards and their logs, the clipped losses, PEFT, accelerate, checkpoints.
This subclass replaces where rows come from. For each generation batch it runs one episode per task row, lets TRL see
one stand-in row per episode so that rewards, groups and logs stay its own, and then puts all sequences of all episodes
in their place: advantages per episode, a fixed number of micro-batches, the denominator counted over what is trained.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from accelerate.utils import gather_object
from torch import nn
from transformers.trainer_utils import PREFIX_CHECKPOINT_DIR, rotate_checkpoints
from trl import GRPOTrainer

from agentspec.episode import MakeEnv, Runner, make_env
from agentspec.llm.base import LLM
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory
from trainers.audit import receipt_rows
from trainers.batches import Row, blank_row, collate, deal, rows_logprobs
from trainers.config import ScaffoldConfig
from trainers.resume import (
    ScaffoldState,
    last_complete_checkpoint,
    load_state,
    restore_finished,
    rewind_logs,
    rows_of,
    save_state,
    unmark,
)
from trainers.rollouts import collect, rollout_jobs
from trainers.runlog import RunLog, paths_called, transcript
from trainers.sequences import build_sequences
from trainers.tree import enable_tree
from trainers.weighing import weigh

ROWS = "rows"
"""Key under which a micro-batch carries its rows beside the tensors that TRL reads."""


class ScaffoldGRPOTrainer(GRPOTrainer):
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
        self._episodes: list[Trajectory] = []
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
        self._make_llm = make_llm or local_llm
        self._llm: LLM | None = None
        self._round = 0
        self._memory: bytes | None = None

    def train(self, resume_from_checkpoint: str | bool | None = None, **kwargs: Any) -> Any:
        """As TRL's; first writes the run's manifest (configuration, scaffold, versions, command).

        ``resume_from_checkpoint=True`` means the last complete checkpoint in ``output_dir``, if there is one.
        """
        if resume_from_checkpoint is True:
            resume_from_checkpoint = str(last_complete_checkpoint(self.args.output_dir) or "")
        if self.accelerator.is_main_process:
            config, spec = self.args.to_dict(), self.args.spec.to_data()
            self.run_log.manifest(config=config, spec=spec, resumed_from=str(resume_from_checkpoint or ""))
            if not resume_from_checkpoint:
                rewind_logs(self.run_log, 0)  # of a run that ended before its first checkpoint, say
        finished = restore_finished(self, resume_from_checkpoint) if resume_from_checkpoint else None
        return finished or super().train(resume_from_checkpoint=resume_from_checkpoint or None, **kwargs)

    @property
    def last_episodes(self) -> list[Trajectory]:
        """This rank's episodes of the last generation round."""
        return self._episodes

    # --- rollouts ----------------------------------------------------------------------------------------------------

    @property
    def llm(self) -> LLM:
        """The backend that samples from the live policy."""
        if self._llm is None and self.use_vllm:
            from agentspec.llm.vllm import VLLMBackend, colocated, server

            engine = (server if self.vllm_mode == "server" else colocated)(self.vllm_generation)
            length = self.args.vllm_max_model_length or self.model.config.max_position_embeddings
            self._llm = VLLMBackend(engine, self.processing_class, max_context=length)
        if self._llm is None:
            self._llm = self._make_llm(self.accelerator.unwrap_model(self.model), self.processing_class)
        return self._llm

    def _reward_function(self, name: str) -> Callable[..., list[float | None]]:
        """A TRL reward function that reads the finished episodes."""

        def reward(**_: Any) -> list[float | None]:
            terms = [self.rewards_used.terms(t) for t in self._episodes]
            return [None if t is None else t[name] for t in terms]

        reward.__name__ = name
        return reward

    def _generate(self, prompts: list[Any]) -> tuple[Any, ...]:
        """One stand-in row per episode for TRL; the episodes themselves are kept aside.

        Returns TRL's tuple: prompt ids, completion ids, tool mask, completions, log-probs, extra fields, images, tool
        images.
        """
        rows, mode = self._task_rows, "train" if self.model.training else "eval"
        group = self.num_generations if mode == "train" else self.num_generations_eval
        jobs = rollout_jobs(
            rows,
            seed=self.args.seed,
            round=self._round,
            first=self.accelerator.process_index * len(rows),
            group=group,
            memory=self._memory,
        )
        runner = Runner(
            self.args.spec,
            self.llm,
            make_env=self._make_env,
            concurrency=self.args.rollout_concurrency or None,
            timeout_s=self.args.env_timeout_s,
            policy=f"step-{self.state.global_step}",
        )
        self._sync_weights()
        self._episodes = collect(runner, jobs, retries=self.args.retries, rewards=self.rewards_used)
        self._log_episodes(mode)
        if mode == "train":
            self._memory = self._carried_memory()
        stand_in = [self._tokenizer.pad_token_id]
        completions = [[{"role": "assistant", "content": transcript(t)}] for t in self._episodes]
        n = len(self._episodes)
        return [stand_in] * n, [stand_in] * n, [[0]] * n, completions, None, {}, None, []

    def _sync_weights(self) -> None:
        """Make the backend sample from the weights as they are now."""
        if self.use_vllm:
            if self.state.global_step != self._last_loaded_step:
                self.vllm_generation.sync_weights()
                self._last_loaded_step = self.state.global_step
            return
        invalidate = getattr(self.llm, "invalidate", None)
        if invalidate is not None:
            invalidate()

    def _generate_and_score_completions(self, inputs: list[dict[str, Any]]) -> dict[str, Any]:
        self._task_rows = inputs
        mode = "train" if self.model.training else "eval"
        super()._generate_and_score_completions(inputs)  # rewards, their logs, and TRL's metrics
        rows = self._rows(mode)
        return {ROWS: rows}

    def _rows(self, mode: str) -> list[Row]:
        """All sequences of this rank's episodes with the advantages of the whole group."""
        weighed = weigh(
            self._episodes,
            self.args,
            self.rewards_used,
            group=self.num_generations if mode == "train" else self.num_generations_eval,
            rank=self.accelerator.process_index,
            gather=gather_object,
        )
        for name, value in weighed.metrics.items():
            self._metrics[mode][name].append(value)
        scored = [t for t in self._episodes if t.scorable]
        if mode == "train" and scored and not any(build_sequences(t, self.args.train_filter) for t in scored):
            raise SpecError(
                f"no call of this generation batch matched train_calls {self.args.train_calls} with credits "
                f"{self.args.train_credits}; the scaffold called {sorted(paths_called(self._episodes))}"
            )
        return weighed.rows

    def _carried_memory(self) -> bytes | None:
        """With ``scope: run``: the memory that the next round starts from, the same on every rank."""
        if self.args.spec.scope != "run":
            return None
        local = [(self.rewards_used.total(t), t.memory_state) for t in self._episodes]
        scored = [(value, state) for value, state in gather_object(local) if value is not None]
        if not scored:
            return self._memory
        state: bytes | None = (scored[0] if self.args.memory_carry == "first" else max(scored, key=lambda s: s[0]))[1]
        return state

    # --- updates -----------------------------------------------------------------------------------------------------

    def _prepare_inputs(self, generation_batch: Any) -> dict[str, Any]:
        """The next micro-batch; a new generation round when the buffered ones are used up."""
        if not self.model.training:
            rows = self._generate_and_score_completions(generation_batch)[ROWS]
            return self._micro_batches(rows, 1)[0]
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
        mode = "train" if self.model.training else "eval"
        difference = (logps.detach() - inputs["sampled_logprobs"]).abs() * inputs["tool_mask"]
        self._metrics[mode]["sampling/logp_difference_max"].append(difference.max().item())
        return logps, entropies, None

    # --- checkpoints ---------------------------------------------------------------------------------------------

    def _save_checkpoint(self, model: nn.Module, trial: Any) -> None:
        """As TRL's; the main process's state is written last, and older checkpoints go only after that."""
        run = self._get_output_dir(trial=trial)
        folder = Path(run) / f"{PREFIX_CHECKPOINT_DIR}-{self.state.global_step}"
        main = self.accelerator.is_main_process
        if main:
            unmark(folder)
        limit, self.args.save_total_limit = self.args.save_total_limit, None
        try:
            super()._save_checkpoint(model, trial)
        finally:
            self.args.save_total_limit = limit
        unused = self._step % self._steps_per_round != 0
        buffered = rows_of(self._buffered_inputs, ROWS) if unused else ()
        state = ScaffoldState(self._step, self._round, buffered, self._memory)
        if not main:
            save_state(folder, state, self.accelerator.process_index)
        self.accelerator.wait_for_everyone()
        if main:
            save_state(folder, state)
            best = self.state.best_model_checkpoint
            rotate_checkpoints(run, save_total_limit=limit, best_model_checkpoint=best, use_mtime=True)

    def _get_train_sampler(self, dataset: Any = None) -> Any:
        self._task_sampler = super()._get_train_sampler(dataset)
        return self._task_sampler

    def _load_optimizer_and_scheduler(self, checkpoint: str | None) -> None:
        super()._load_optimizer_and_scheduler(checkpoint)
        if checkpoint and self._task_sampler.shuffle:
            # The sampler draws one order of tasks per epoch; those of finished epochs were drawn before the stop.
            for _ in range(int((self.state.epoch or 0.0) + 1e-6)):
                torch.randperm(self._task_sampler.num_samples, generator=self._task_sampler.generator)
        state = load_state(checkpoint, self.accelerator.process_index) if checkpoint else None
        if state is None:
            return
        self._step, self._round, self._memory = state.step, state.round, state.memory
        if state.buffered:
            self._buffered_inputs = self._collated([list(hand) for hand in state.buffered])
        if self.accelerator.is_main_process:
            rewind_logs(self.run_log, self.state.global_step)

    # --- logs --------------------------------------------------------------------------------------------------------

    def _log_episodes(self, mode: str) -> None:
        """Scaffold metrics of this rank's episodes, and the trajectories themselves."""
        scored = [t for t in self._episodes if t.scorable]
        for name in ("steps", "invalid_actions", "llm_calls", "input_tokens", "output_tokens", "deliveries"):
            values = [float(t.metrics[name]) for t in scored if name in t.metrics]
            if values:
                self._metrics[mode][f"episode/{name}"].append(sum(values) / len(values))
        if mode == "train":
            self.run_log.trajectories(self._round, self.accelerator.process_index, self._episodes)

    def _log_update(self, rows: Sequence[Row]) -> None:
        """The receipt of a generation round: what every rank contributed, written by the main process."""
        first = self.accelerator.process_index * len(self._episodes)
        receipts = [{**r, "episode": first + r["episode"]} for r in receipt_rows(rows)]
        blank = sum(r.episode < 0 for batch in self._buffered_inputs for r in batch[ROWS])
        episodes = [(t.episode, self.rewards_used.total(t)) for t in self._episodes]
        everyone = {"rows": gather_object(receipts), "blank": gather_object([blank])}
        played = gather_object(episodes)
        if not self.accelerator.is_main_process:
            return
        self.run_log.append(
            "updates.jsonl",
            {
                "round": self._round,
                "episodes": [name for name, _ in played],
                "returns": [value for _, value in played],
                "rows": everyone["rows"],
                "blank_rows": sum(everyone["blank"]),
                "denominator": int(self._buffered_inputs[0]["num_items_in_batch"]),
                "estimator": self.args.estimator,
                "loss_type": self.loss_type,
            },
        )

    def log(self, logs: dict[str, float], start_time: float | None = None) -> None:
        super().log(logs, start_time)
        summary = "train_runtime" in logs  # of a whole (part of a) run, not of an update
        if self.accelerator.is_main_process and self.model.training and not summary:
            self.run_log.append("metrics.jsonl", {"step": self.state.global_step, **logs})


def local_llm(model: nn.Module, tokenizer: Any) -> LLM:
    """The local backend over the live policy."""
    from agentspec.llm.local import LocalLLM

    return LocalLLM(model, tokenizer, name="policy")
