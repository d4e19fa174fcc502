"""Invariants 1, 3 and 4 where they bite: the gradient that reaches the optimiser.

Episodes are prebuilt (random tokens), so that stock TRL and this trainer see exactly the same data.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch

pytest.importorskip("trl")

from datasets import Dataset
from peft import LoraConfig, get_peft_model
from transformers import TrainerCallback
from trl import GRPOConfig, GRPOTrainer

from agentspec.llm.base import LLM
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from tests.tiny import tiny_model, tiny_tokenizer
from tests.trainers.builders import call, episode, instead_of_playing
from trainers import grpo as grpo_module
from trainers.config import ScaffoldConfig
from trainers.forward import rows_logprobs
from trainers.grpo import ScaffoldGRPOTrainer
from trainers.losses import LOSSES
from trainers.micro_batches import collate
from trainers.rollouts import task_rows
from trainers.sequences import Row, build_sequences

GROUPS, GENERATIONS = 2, 4
RETURNS = [15.0, 10.0, 5.0, 15.0, 1.0, 0.0, 0.0, 0.5]


class GradientSpy(TrainerCallback):
    """Keeps the gradients of the first optimiser step and counts the steps."""

    def __init__(self) -> None:
        self.gradients: dict[str, torch.Tensor] = {}
        self.steps = 0

    def on_pre_optimizer_step(self, args: Any, state: Any, control: Any, **kwargs: Any) -> None:
        self.steps += 1
        if not self.gradients:
            named = kwargs["model"].named_parameters()
            self.gradients = {n: p.grad.clone() for n, p in named if p.grad is not None}


def settings(tmp_path: Any, **changes: Any) -> dict[str, Any]:
    return {
        "output_dir": str(tmp_path),
        "per_device_train_batch_size": 4,
        "gradient_accumulation_steps": 2,
        "num_generations": GENERATIONS,
        "max_steps": 1,
        "learning_rate": 1e-3,
        "lr_scheduler_type": "constant",
        "max_grad_norm": 0.0,
        "optim": "sgd",
        "report_to": [],
        "use_cpu": True,
        "bf16": False,
        "gradient_checkpointing": False,
        "save_strategy": "no",
        "logging_steps": 1,
        "disable_tqdm": True,
        **({"max_completion_length": 40} if changes.get("loss_type") == "dr_grpo" else {}),
        "shuffle_dataset": False,
        **changes,
    }


def random_calls(seed: int, turns: int, vocabulary: int = 250) -> list[Any]:
    """An append-only conversation of ``turns`` calls with random tokens (log-probs are filled in by the model)."""
    g = torch.Generator().manual_seed(seed)

    def draw(low: int, high: int) -> list[int]:
        n = int(torch.randint(low, high, (1,), generator=g))
        return torch.randint(0, vocabulary, (n,), generator=g).tolist()

    prompt, calls = draw(3, 9), []
    for i in range(turns):
        answer = draw(2, 6)
        calls.append(call(i, prompt, answer, step=i))
        prompt = prompt + answer + draw(2, 5)
    return calls


def spied(trainer: GRPOTrainer) -> GradientSpy:
    spy = GradientSpy()
    trainer.add_callback(spy)
    trainer.train()
    return spy


def our_trainer(
    tmp_path: Any, episodes: list[Trajectory], monkeypatch: Any, model: Any = None, **changes: Any
) -> ScaffoldGRPOTrainer:
    """This trainer, playing given episodes."""
    tokenizer = tiny_tokenizer()
    tasks = task_rows([Task("toy", i) for i in range(GROUPS)])
    monkeypatch.setattr(grpo_module, "collect", instead_of_playing(lambda jobs: episodes))
    return ScaffoldGRPOTrainer(
        model or tiny_model(tokenizer),
        ScaffoldConfig(**settings(tmp_path, **changes)),
        train_dataset=Dataset.from_list(tasks),
        processing_class=tokenizer,
        make_llm=lambda model, tokenizer: object.__new__(type("Unused", (LLM,), {})),
    )


def ours(tmp_path: Any, episodes: list[Trajectory], monkeypatch: Any, model: Any = None, **changes: Any) -> GradientSpy:
    return spied(our_trainer(tmp_path, episodes, monkeypatch, model, **changes))


def stock_trainer(tmp_path: Any, episodes: list[Trajectory], model: Any = None, **changes: Any) -> GRPOTrainer:
    """TRL's own trainer on the same tokens and returns; every episode is one sequence."""
    sequences = [s for e in episodes for s in build_sequences(e)]
    assert len(sequences) == len(episodes)
    prompts = [s.mask.index(1) for s in sequences]  # lengths: what comes before the first trained token

    def rollout_func(_: list[Any], trainer: Any) -> dict[str, Any]:
        return {
            "prompt_ids": [s.tokens[:n] for s, n in zip(sequences, prompts, strict=True)],
            "completion_ids": [s.tokens[n:] for s, n in zip(sequences, prompts, strict=True)],
            "env_mask": [s.mask[n:] for s, n in zip(sequences, prompts, strict=True)],
            "logprobs": [s.logprobs[n:] for s, n in zip(sequences, prompts, strict=True)],
            "value": [sum(t.reward for t in e.transitions) for e in episodes],
        }

    def earning_delta(value: list[float], **_: Any) -> list[float]:
        return value

    tokenizer = tiny_tokenizer()
    return GRPOTrainer(
        model or tiny_model(tokenizer),
        reward_funcs=earning_delta,
        args=GRPOConfig(**settings(tmp_path, **changes)),
        train_dataset=Dataset.from_list([{"prompt": str(i)} for i in range(GROUPS)]),
        processing_class=tokenizer,
        rollout_func=rollout_func,
    )


def relative_difference(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> float:
    assert a.keys() == b.keys()
    difference = math.sqrt(sum((a[n] - b[n]).square().sum().item() for n in a))
    return difference / math.sqrt(sum(g.square().sum().item() for g in b.values()))


# Group 0 has no variance; in group 1 two rollouts stand at the mean (1, 0, .5, .5: mean .5).
ZERO_ADVANTAGES = [3.0, 3.0, 3.0, 3.0, 1.0, 0.0, 0.5, 0.5]
ONE_MICRO_BATCH = {"per_device_train_batch_size": 8, "gradient_accumulation_steps": 1}
# What looks at one micro-batch at a time can be compared only where there is one.
CASES: list[dict[str, Any]] = [{"loss_type": name} for name, spec in LOSSES.items() if spec.trl and name != "bnpo"]
CASES += [ONE_MICRO_BATCH | {"loss_type": "bnpo"}, ONE_MICRO_BATCH | {"top_entropy_quantile": 0.5}]


def conversations(returns: list[float]) -> list[Trajectory]:
    """One to three turns in one sequence each, paid at the end."""
    turns = [1 + i % 3 for i in range(len(returns))]
    return [
        episode(random_calls(i, turns=n), [0.0] * (n - 1) + [r], rollout=i % GENERATIONS)
        for i, (n, r) in enumerate(zip(turns, returns, strict=True))
    ]


@pytest.mark.parametrize("returns", [RETURNS, ZERO_ADVANTAGES], ids=["spread", "zero_advantages"])
@pytest.mark.parametrize("changes", CASES, ids=lambda c: "-".join(map(str, c.values())))
def test_single_sequence_work_equals_stock_trl(
    tmp_path: Any, monkeypatch: Any, changes: dict[str, Any], returns: list[float]
) -> None:
    episodes = conversations(returns)
    spy = ours(tmp_path / "ours", episodes, monkeypatch, **changes)
    other = spied(stock_trainer(tmp_path / "stock", episodes, **changes))
    assert relative_difference(spy.gradients, other.gradients) < 1e-5


def with_lora(seed: int = 0) -> Any:
    torch.manual_seed(seed)
    lora = LoraConfig(r=2, lora_alpha=4, target_modules=["q_proj", "v_proj"])
    return get_peft_model(tiny_model(tiny_tokenizer()), lora)


def moved_from_its_start(trainer: GRPOTrainer) -> GRPOTrainer:
    """The policy a little away from what its reference is."""
    g = torch.Generator().manual_seed(3)
    for name, parameter in trainer.model.named_parameters():
        if ".default." in name:
            parameter.data += 0.05 * torch.randn(parameter.shape, generator=g)
    return trainer


def answers(returns: list[float]) -> list[Trajectory]:
    """One call each; half of the answers end with the end-of-sequence token, the others were cut off."""
    end = tiny_tokenizer().eos_token_id
    episodes = []
    for i, value in enumerate(returns):
        (c,) = random_calls(i, 1)
        ids = [*c.completions[0].token_ids, *([end] if i % 2 else [])]
        logprobs = tuple([-1.0] * len(ids))
        done = replace(
            c.completions[0], token_ids=tuple(ids), logprobs=logprobs, finish_reason="stop" if i % 2 else "length"
        )
        episodes.append(episode([replace(c, completions=(done,))], [value], rollout=i % GENERATIONS))
    return episodes


@pytest.mark.parametrize("changes", [{}, {"loss_type": "cispo"}, {"beta": 0.1}], ids=["dapo", "cispo", "kl"])
def test_metrics_are_those_of_stock_trl(tmp_path: Any, monkeypatch: Any, changes: dict[str, Any]) -> None:
    episodes = answers(ZERO_ADVANTAGES)
    build = {
        "ours": partial(our_trainer, episodes=episodes, monkeypatch=monkeypatch),
        "stock": partial(stock_trainer, episodes=episodes),
    }
    logged: dict[str, dict[str, float]] = {}
    for name, make in build.items():
        trainer = make(
            tmp_path / name, model=with_lora() if changes.get("beta") else None, **ONE_MICRO_BATCH, **changes
        )
        (moved_from_its_start(trainer) if changes.get("beta") else trainer).train()
        logged[name] = {k: v for k, v in trainer.state.log_history[0].items() if k != "step_time"}
    mine, theirs = logged["ours"], logged["stock"]
    assert set(theirs) <= set(mine)  # every name that TRL logs
    assert {"reward", "frac_reward_zero_std", "completions/clipped_ratio", "num_tokens", "entropy"} <= set(theirs)
    assert {"kl"} <= set(theirs) or "beta" not in changes
    for name, value in theirs.items():
        assert mine[name] == pytest.approx(value, rel=1e-4, abs=1e-5), name


@pytest.mark.parametrize("loss_type", ["dr_grpo", "dppo"])
def test_losses_of_ours_do_not_depend_on_rows(tmp_path: Any, monkeypatch: Any, loss_type: str) -> None:
    """13 rows of 8 episodes: the sum over trained tokens over one number, by hand."""
    episodes = uneven_episodes()
    spy = ours(tmp_path, episodes, monkeypatch, loss_type=loss_type)
    returns = torch.tensor(RETURNS).view(GROUPS, GENERATIONS)
    advantages = ((returns - returns.mean(1, keepdim=True)) / (returns.std(1, keepdim=True) + 1e-4)).flatten()
    rows = [(s, advantages[i].item()) for i, e in enumerate(episodes) for s in build_sequences(e)]
    # On policy both are the plain policy gradient; dr_grpo divides by 8 rollouts x 40 tokens, dppo by the tokens.
    trained = sum(s.trained for s, _ in rows)
    factor = trained / (8 * 40) if loss_type == "dr_grpo" else 1.0
    expected = manual_gradient(rows, tiny_model(tiny_tokenizer()))
    assert relative_difference(spy.gradients, {n: g * factor for n, g in expected.items()}) < 1e-5


def manual_gradient(rows: list[tuple[Any, float]], model: Any) -> dict[str, torch.Tensor]:
    """-sum(A log p) / (number of trained tokens), token by token, one plain forward per row."""
    total = sum(s.trained for s, _ in rows)
    for sequence, advantage in rows:
        logits = model(input_ids=torch.tensor([sequence.tokens])).logits[0].float()
        loss = torch.zeros(())
        for position, trained in enumerate(sequence.mask):
            if trained:
                scores = logits[position - 1] / sequence.temperatures[position]
                allowed = sequence.allowed.get(position)
                if allowed is not None:
                    outside = torch.ones_like(scores, dtype=torch.bool)
                    outside[list(allowed)] = False
                    scores = scores.masked_fill(outside, -torch.inf)
                log_p = scores.log_softmax(-1)[sequence.tokens[position]]
                loss = loss - advantage * log_p / total
        loss.backward()
    return {n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None}


def uneven_episodes() -> list[Trajectory]:
    """1 to 3 rows per episode: 13 rows in all, which 2 micro-batches do not divide."""
    episodes = []
    for i, (rows, value) in enumerate(zip([3, 1, 1, 2, 1, 2, 1, 2], RETURNS, strict=True)):
        calls = []
        for r in range(rows):
            (c,) = random_calls(100 * i + r, 1)
            ids, answer = [r, *c.prompt_ids], list(c.completions[0].token_ids)
            calls.append(call(len(calls), ids, answer, temperature=0.7 + 0.3 * r))
        episodes.append(episode(calls, [value], rollout=i % 4))
    return episodes


@pytest.mark.parametrize(
    "packing", [{"packing": "tree"}, {"packing": "tree", "tokens_per_forward": 30}, {"packing": "padded"}]
)
def test_uneven_rows_give_the_full_batch_gradient_in_one_step(
    tmp_path: Any, monkeypatch: Any, packing: dict[str, Any]
) -> None:
    episodes = uneven_episodes()
    spy = ours(tmp_path, episodes, monkeypatch, loss_type="dapo", **packing)
    assert spy.steps == 1
    returns = torch.tensor(RETURNS).view(GROUPS, GENERATIONS)
    # TRL's convention: sample deviation + 1e-4.
    advantages = ((returns - returns.mean(1, keepdim=True)) / (returns.std(1, keepdim=True) + 1e-4)).flatten()
    rows = [(s, advantages[i].item()) for i, e in enumerate(episodes) for s in build_sequences(e)]
    assert len(rows) == 13
    assert relative_difference(spy.gradients, manual_gradient(rows, tiny_model(tiny_tokenizer()))) < 1e-5


def test_constrained_tokens_have_the_gradient_of_the_constrained_policy(tmp_path: Any, monkeypatch: Any) -> None:
    episodes = []
    for i, value in enumerate(RETURNS):
        c = call(0, [1, 2, 3 + i], [5, 7, 9], allowed=((5, 6, 8), (7,), (9, 10)), logprobs=[-1.0, 0.0, -1.0])
        episodes.append(episode([c], [value], rollout=i % 4))
    spy = ours(tmp_path, episodes, monkeypatch)
    returns = torch.tensor(RETURNS).view(GROUPS, GENERATIONS)
    advantages = ((returns - returns.mean(1, keepdim=True)) / (returns.std(1, keepdim=True) + 1e-4)).flatten()
    rows = [(s, advantages[i].item()) for i, e in enumerate(episodes) for s in build_sequences(e)]
    assert all(s.trained == 2 for s, _ in rows)
    assert relative_difference(spy.gradients, manual_gradient(rows, tiny_model(tiny_tokenizer()))) < 1e-5


def test_a_failed_rollout_counts_nowhere(tmp_path: Any, monkeypatch: Any) -> None:
    episodes = [episode(random_calls(i, 1), [r], rollout=i % 4) for i, r in enumerate(RETURNS)]
    episodes[1] = episode(random_calls(1, 1), [1e6], status="failed", rollout=1)
    spy = ours(tmp_path, episodes, monkeypatch)
    # Group 0 without its second member: returns 15, 5, 15 have mean 11.667 and sample deviation 5.774.
    first = torch.tensor([15.0, 5.0, 15.0])
    a = ((first - first.mean()) / (first.std() + 1e-4)).tolist()
    second = torch.tensor(RETURNS[4:])
    b = ((second - second.mean()) / (second.std() + 1e-4)).tolist()
    advantages = [a[0], None, a[1], a[2], *b]
    rows = [(build_sequences(e)[0], v) for e, v in zip(episodes, advantages, strict=True) if v is not None]
    assert relative_difference(spy.gradients, manual_gradient(rows, tiny_model(tiny_tokenizer()))) < 1e-5


def test_groups_without_variance_leave_the_policy_alone(tmp_path: Any, monkeypatch: Any) -> None:
    episodes = [episode(random_calls(i, 1), [3.0], rollout=i % 4) for i in range(8)]
    spy = ours(tmp_path, episodes, monkeypatch)
    assert spy.steps == 1
    assert all(g.abs().max() == 0 for g in spy.gradients.values())


def test_padded_forwards_equal_row_by_row_ones() -> None:
    tokenizer = tiny_tokenizer()
    model = tiny_model(tokenizer)
    rows = [Row(s, 1.0, i) for i, e in enumerate(uneven_episodes()) for s in build_sequences(e)]
    alone, _ = rows_logprobs(model, rows)
    together, _ = rows_logprobs(model, rows, tokens_per_forward=60)
    mask = collate(rows, 0)["tool_mask"]
    assert mask.sum() > 0 and torch.allclose(alone, together, atol=1e-5)
    assert (alone * (1 - mask)).abs().max() == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"train_calls": ["reflection.*"]}, "match no call"),
        ({"agent": {"reasoning": "direct", "sampling": {"top_p": 0.9}}}, "top_p"),
        ({"agent": {"reasoning": "direct", "sampling": {"temperature": 0}}}, "temperature"),
        ({"agent": {"reasoning": "raect"}}, "did you mean react"),
        ({"loss_type": "luspo"}, "not offered"),
        ({"estimator": "gpro"}, "did you mean grpo"),
        ({"rewards": {"earnings": 1.0}}, "earning_delta"),
        ({"importance_sampling_level": "sequence"}, "speaks of rows"),
        ({"environment": {"map": "x"}}, "expected {name"),
    ],
)
def test_what_cannot_work_is_refused_at_start(tmp_path: Any, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message.replace("{", r"\{")):
        ScaffoldConfig(**settings(tmp_path, **changes)).check()


def test_a_cpu_computes_in_float32_unless_it_is_told_otherwise(tmp_path: Any) -> None:
    unsaid = {k: v for k, v in settings(tmp_path).items() if k != "bf16"}
    assert ScaffoldConfig(**unsaid).bf16 is False
    assert ScaffoldConfig(**unsaid, bf16=True).bf16 is True
