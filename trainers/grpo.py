"""GRPO inside the scaffold: TRL's trainer, fed by episodes.

TRL keeps what it is good at: configuration, the clipped losses, PEFT, accelerate, logs, checkpoints. This subclass
replaces where micro-batches come from: for each generation round it plays one episode per task row, scores it once,
credits whole groups (`trainers.credit`), partitions all sequences of all episodes into a fixed number of
micro-batches, and counts the denominator over what is trained.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from accelerate.utils import gather_object
from torch import nn
from trl import GRPOTrainer

from agentspec.carry import MemoryBank
from agentspec.episode import Job, MakeEnv, Runner, make_env
from agentspec.llm.base import LLM
from agentspec.progress import episode_progress
from agentspec.records.folder import EVALUATIONS, METRICS, last_complete_checkpoint
from agentspec.records.log import RunLog
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from trainers.call_metrics import CallMetrics, truncated_calls
from trainers.card import OwnCards
from trainers.config import ScaffoldConfig
from trainers.counterfactuals import FOLDER as COUNTERFACTUALS
from trainers.counterfactuals import play_beside
from trainers.counterfactuals import records as counterfactuals
from trainers.credit import Credited, ScoredEpisode
from trainers.distributed import check_layout, check_trained, is_sharded, keep_precision
from trainers.finite import FiniteGuard, without_dropout
from trainers.forward import frozen_output
from trainers.frozen import FrozenOutput, frozen_layers, layer_above
from trainers.losses import UpdateSize, loss
from trainers.micro_batches import PADDED, ROWS, collate, padding_row, partition
from trainers.policy_loss import PolicyLoss
from trainers.receipts import receipt_record, receipt_rows, settings
from trainers.resume import ExactResume, restore_finished
from trainers.rollouts import collect, local_llm, rollout_jobs
from trainers.round_metrics import SamplingMetrics, episode_metrics, named, round_metrics
from trainers.sequences import Row
from trainers.tree.model import enable_tree
from trainers.validation import Validation
from trainers.vllm import prepare_vllm, vllm_round


class ScaffoldGRPOTrainer(ExactResume, OwnCards, Validation, PolicyLoss, GRPOTrainer):
    """GRPO whose rollouts are episodes of an agent.

    Args:
        model: the policy, already loaded (a `PeftModel` or any causal LM).
        args: see `trainers.config.ScaffoldConfig`.
        train_dataset: rows of `trainers.rollouts.task_rows`.
        make_llm: model, tokenizer -> the backend that samples from the live policy (default: the local one).
        make_env: task -> environment.
        kwargs: passed on to `trl.GRPOTrainer`.
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
        prepare_vllm(args)
        self.rewards_used = args.reward_set
        self.credit_rule = args.credit_rule
        self._played: list[ScoredEpisode] = []
        self._buffered_inputs: Any = None
        self._last_loaded_step = -1
        super().__init__(model, [named(name) for name in self.rewards_used.weights], args, **kwargs)
        self.loss_spec = loss(args.loss_type)
        self.loss_type = self.loss_spec.trl  # whose code of TRL's computes it, if any does
        for policy in filter(None, (self.model, self.ref_model)):
            without_dropout(policy)
            if args.packing == "tree":
                enable_tree(self.accelerator.unwrap_model(policy))
        self.add_callback(FiniteGuard)
        self._packing: dict[str, Any] = {"packing": args.packing, "tokens_per_forward": args.tokens_per_forward}
        self._frozen = [] if is_sharded(self.accelerator) else frozen_layers(self.accelerator.unwrap_model(self.model))
        self._recorder: Any = None  # of their output, while the local backend plays
        self._below: FrozenOutput | None = None
        self.run_log = RunLog(args.output_dir)
        self._make_env = make_env
        self._make_llm = make_llm or partial(local_llm, batching=args.batching)
        self._llm: LLM | None = None
        self._round = 0
        self._memory: bytes | None = args.starting_memory
        self._call_metrics = CallMetrics()
        self._sampling_metrics = SamplingMetrics()

    def create_accelerator_and_postprocess(self) -> None:
        """As transformers'; nothing is built on a parallel layout that would hang or round."""
        super().create_accelerator_and_postprocess()
        check_layout(self.accelerator, self.args)
        keep_precision(self.accelerator)

    def train(self, resume_from_checkpoint: str | bool | None = None, **kwargs: Any) -> Any:
        """As TRL's, in a folder that belongs to this run; its manifest is written first, its records are sealed last.

        `resume_from_checkpoint=True` means the last complete checkpoint in `output_dir`, if there is one.
        """
        if resume_from_checkpoint is True:
            resume_from_checkpoint = str(last_complete_checkpoint(self.args.output_dir) or "")
        with self._recorded(str(resume_from_checkpoint or "")):
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
            model = self.accelerator.unwrap_model(self.model)
            self._llm = self._make_llm(model, self.processing_class)
            # An update that finds a round half done, after a restart, could not have what the rollouts left.
            if self._frozen and not self._off_policy and hasattr(self._llm, "record_states"):
                self._recorder = self._llm.record_states(layer_above(model, self._frozen))
        return self._llm

    def _play_round(self, rows: list[dict[str, Any]]) -> list[ScoredEpisode]:
        """This rank's episodes of a generation round, one per task row, scored."""
        jobs = rollout_jobs(
            rows,
            seed=self.args.seed,
            round=self._round,
            first=self.accelerator.process_index * len(rows),
            group=self.num_generations,
            memory=self._memory,
        )
        with self._current_weights():
            if self._recorder:
                self._recorder.clear()
            episodes = self._play(jobs)
            if self.credit_rule.writes.spec.function is None:
                return episodes
            runner = replace(self._runner(self.args.spec), progress=None)
            return play_beside(runner, jobs, episodes, self.credit_rule, retries=self.args.retries)

    def _runner(self, spec: AgentSpec) -> Runner:
        """Runs episodes of `spec` with the policy as it is."""
        return Runner(
            spec,
            self.llm,
            make_env=self._make_env,
            concurrency=self.args.rollout_concurrency or None,
            timeout_s=self.args.env_timeout_s,
            progress=episode_progress if self.accelerator.is_main_process else None,
            policy=f"step-{self.state.global_step}",
        )

    def _play(self, jobs: Sequence[Job], spec: AgentSpec | None = None) -> list[ScoredEpisode]:
        """One episode per job, in order, those that failed among them; `spec`: another than the training scaffold.

        Where there are several of these (`scaffolds`), a rollout's or a task's number says in which one it is played.
        """
        specs, across = [spec] if spec else self.args.mixture, self.args.scaffold_groups == "across"
        places = [(job.rollout if across else job.task.seed) % len(specs) for job in jobs]
        played: dict[int, ScoredEpisode] = {}
        for number, one in enumerate(specs):
            if mine := [i for i, place in enumerate(places) if place == number]:
                runner, share = self._runner(one), [jobs[i] for i in mine]
                played |= zip(mine, collect(runner, share, self.rewards_used, retries=self.args.retries), strict=True)
        return [played[i] for i in range(len(jobs))]

    @contextmanager
    def _current_weights(self) -> Iterator[None]:
        """Inside this block the backend samples from the weights as they are now."""
        if self.use_vllm:
            stale = self.state.global_step != self._last_loaded_step
            self._last_loaded_step = self.state.global_step
            with vllm_round(self.vllm_generation, stale=stale):
                yield
            return
        getattr(self.llm, "invalidate", lambda: None)()
        yield
        getattr(self.llm, "give_back", lambda: None)()  # the update needs the memory

    def _check_trained(self) -> None:
        """Refuse a generation batch that trains nothing, on all ranks together."""
        check_trained(self.last_episodes, self.credit_rule.train, gather_object)

    def _carried_memory(self) -> bytes | None:
        """With `scope: run`: the bank of memories that the next round starts from, the same on every rank.

        Each task carries the memory of one of its own rollouts.
        """
        if self.args.spec.scope != "run":
            return None
        bank = MemoryBank.of_spec(self.args.spec) if self._memory is None else MemoryBank.load(self._memory)
        played = [(e.trajectory.task.key, e.total, e.trajectory.memory_state) for e in self._played]
        return bank.carried(gather_object(played), self.args.memory_carry).dump()

    # --- updates -----------------------------------------------------------------------------------------------------

    def _prepare_inputs(self, generation_batch: Any) -> dict[str, Any]:
        """The next micro-batch; a new generation round when the buffered ones are used up."""
        if self._step % self._steps_per_round == 0 or self._buffered_inputs is None:
            self._round = self.state.global_step
            self._below = None  # not held while episodes are played
            self._played = self._play_round(generation_batch)
            self._memory = self._carried_memory()
            rank = self.accelerator.process_index
            credited = self.credit_rule.credit(self._played, rank=rank, gather=gather_object)
            self._check_trained()
            self._buffered_inputs = self._collated(self._partitioned(credited.rows))
            self._log_episodes(credited)
            self._log_update(credited.rows)
        batch: dict[str, Any] = self._buffered_inputs[self._step % self.args.steps_per_generation]
        return batch

    def _partitioned(self, rows: Sequence[Row]) -> list[list[Row]]:
        """Rows in micro-batches; every rank has as many, of as many rows."""
        count, padding = self.args.steps_per_generation, padding_row(self._tokenizer.pad_token_id)
        size = -(-max(1, *gather_object([len(rows)])) // count)
        return partition(rows, count, padding=padding, size=size, by_prefix=self.args.packing == "tree")

    def _collated(self, micro_batches: list[list[Row]]) -> list[dict[str, Any]]:
        """What the loss reads of each micro-batch; the denominator is that of the whole round, on all ranks."""
        device = self.accelerator.device
        tokens = sum(gather_object([sum(r.sequence.trained for rows in micro_batches for r in rows)]))
        size = UpdateSize(tokens, self.args.generation_batch_size, self.args.max_completion_length)
        denominator = torch.tensor(self.loss_spec.denominator(size), device=device)
        policy, recorded = self.accelerator.unwrap_model(self.model), self._recorder.find if self._recorder else None
        with self.accelerator.autocast():
            everything = [r for rows in micro_batches for r in rows]
            self._below = frozen_output(policy, self._frozen, everything, recorded, **self._packing)
        counts = gather_object([(len(rows), sum(r.episode >= 0 for r in rows)) for rows in micro_batches])
        padded = sum(n for n, _ in counts) / max(1, sum(n for _, n in counts))
        batches = []
        for rows in micro_batches:
            batch: dict[str, Any] = collate(rows, self._tokenizer.pad_token_id, device)
            batch |= {ROWS: rows, "num_items_in_batch": denominator, PADDED: padded}
            if self._off_policy:
                batch["old_per_token_logps"] = batch["sampled_logprobs"]
            if self.beta != 0.0:
                batch["ref_per_token_logps"] = self._reference_logprobs(rows)
            batches.append(batch)
        return batches

    # --- logs --------------------------------------------------------------------------------------------------------

    def _log_episodes(self, credited: Credited) -> None:
        """The figures of a round, and the trajectories themselves."""
        episodes, rule = self.last_episodes, self.credit_rule
        figures = round_metrics(self._played, rule.train, rule.rewards, group=rule.group, gather=gather_object)
        self.state.num_input_tokens_seen += sum(gather_object([sum(len(r.sequence) for r in credited.rows)]))
        figures["num_tokens"] = float(self.state.num_input_tokens_seen)
        figures |= credited.metrics | episode_metrics(episodes) | truncated_calls(episodes, rule.train)
        for name, value in figures.items():
            self._metrics["train"][name].append(value)
        self.run_log.trajectories(self._round, self.accelerator.process_index, episodes)
        if beside := counterfactuals(self._played):
            self.run_log.trajectories(self._round, self.accelerator.process_index, beside, COUNTERFACTUALS)

    def _log_update(self, rows: Sequence[Row]) -> None:
        """The receipt of a generation round: what every rank contributed, written by the main process."""
        rank, played = self.accelerator.process_index, [(e.trajectory.episode, e.total) for e in self._played]
        padding = [sum(r.episode < 0 for batch in self._buffered_inputs for r in batch[ROWS])]
        files = dict(gather_object(list(self.run_log.written().items())))
        record = receipt_record(
            round=self._round,
            played=gather_object(played),
            rows=gather_object(receipt_rows(rows, rank * len(played))),
            padding_rows=sum(gather_object(padding)),
            denominator=int(self._buffered_inputs[0]["num_items_in_batch"]),
            settings=settings(self.args.to_dict()),
        )
        if self.accelerator.is_main_process:
            self.run_log.receipt(record, files, self._memory)

    def log(self, logs: dict[str, float], start_time: float | None = None) -> None:
        summary = "train_runtime" in logs  # of a whole (part of a) run, not of an update
        if self.model.training and not summary:
            logs |= self._call_metrics.flush(gather_object) | self._sampling_metrics.flush(gather_object)
        super().log(logs, start_time)
        if self.accelerator.is_main_process and not summary and not self.run_log.sealed:
            step, name = self.state.global_step, METRICS if self.model.training else EVALUATIONS
            if not self.model.training:
                self.run_log.rewind(name, "step", step - 1)  # a resumed run may evaluate its checkpoint again
            self.run_log.append(name, {"step": step, **logs})
