"""How far the gradient of an update is from the formula that its configuration names.

For every loss, estimator and packing that is offered, one update of a tiny random model is compared with an oracle that
is written out below and shares no numerics with the trainer: it runs one plain forward per model call, in float64, and
sums what the formula says token by token. The batch is made of what goes wrong in practice: ragged episodes of one to
three sequences, constrained and forced tokens, temperatures other than 1, a group without variance, members at their
group's mean, a failed and an overlong episode, calls made after the last step, and recorded log-probabilities that
differ from the policy's, so that ratios are clipped.

    python -m benchmarks.exactness --json
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import json
import math
import random
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any
from unittest.mock import patch

import torch

GROUP, GROUPS, LENGTH = 4, 3, 16
LOW, HIGH, GAMMA, WEIGHT, BETA = 0.2, 0.3, 0.9, 0.5, 0.1


@dataclass(frozen=True)
class Turn:
    """One model call: prompt, what was sampled, under which constraint (`None`: free), and what was recorded of it."""

    step: int
    prompt: list[int]
    answer: list[int]
    allowed: list[tuple[int, ...] | None]
    temperature: float
    sequence: int
    recorded: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Rollout:
    """One episode: rewards per step, the state before each step, and its calls."""

    rewards: list[float]
    states: list[str]
    turns: list[Turn]
    failed: bool = False
    overlong: bool = False


def make_batch(model: Any, seed: int) -> list[Rollout]:
    """Three groups of four rollouts, recorded log-probabilities up to half a nat away from the model's."""
    rng = random.Random(seed)
    # Per rollout its rewards by step. Group 0 has no variance; in group 1 the third stands at the mean of those that
    # did not fail; in group 2 the second is overlong.
    rewards = [
        [[0.0, 2.0]] * 4,
        [[4.0], [0.0, 0.0], [1.0, 1.0], [9.0]],
        [[1.0, 0.0, 2.0], [0.0], [0.0, 1.0], [5.0, 0.0]],
    ]
    batch = []
    for g, r in product(range(GROUPS), range(GROUP)):
        drawn = _turns(rng, len(rewards[g][r]), chains=1 + (g + r) % 3)
        turns = [_recorded(model, turn, rng) for turn in drawn]
        states = [f"{g} {min(t, 1)}" for t in range(len(rewards[g][r]))]
        batch.append(Rollout(rewards[g][r], states, turns, failed=(g, r) == (1, 3), overlong=(g, r) == (2, 1)))
    return batch


def _turns(rng: random.Random, steps: int, chains: int) -> list[Turn]:
    """Two calls per sequence, the second extending the first; the last call stands after the last step."""

    def draw(low: int, high: int) -> list[int]:
        return [rng.randrange(10, 60) for _ in range(rng.randint(low, high))]

    turns: list[Turn] = []
    for chain in range(chains):
        prompt = [chain, *draw(2, 5)]
        for _ in range(2):
            answer = draw(2, 4)
            kinds = [rng.choice(("free", "free", "bound", "forced")) for _ in answer]
            kinds[0] = "free"
            allowed = [
                {"free": None, "bound": tuple(sorted({token, 3, 5, 7})), "forced": (token,)}[kind]
                for token, kind in zip(answer, kinds, strict=True)
            ]
            step = min(len(turns), steps - 1)
            turns.append(Turn(step, prompt, answer, allowed, rng.choice((0.7, 1.0, 1.3)), chain))
            prompt = prompt + answer + draw(1, 3)
    return [*turns, Turn(steps, [99, *draw(2, 3)], draw(2, 3), [None] * 9, 1.0, chains)]


def _recorded(model: Any, turn: Turn, rng: random.Random) -> Turn:
    with torch.no_grad():
        logps = [0.0 if v is None else float(v) + rng.uniform(-0.5, 0.5) for v in token_logprobs(model, turn)]
    return replace(turn, allowed=turn.allowed[: len(turn.answer)], recorded=logps)


# --- the oracle: plain forwards and written-out formulas -------------------------------------------------------------


def token_logprobs(model: Any, turn: Turn) -> list[torch.Tensor | None]:
    """Log-probability of every sampled token; `None` where the constraint left no choice."""
    logits = model(input_ids=torch.tensor([turn.prompt + turn.answer])).logits[0].double()
    values: list[torch.Tensor | None] = []
    for i, token in enumerate(turn.answer):
        scores = logits[len(turn.prompt) + i - 1] / turn.temperature
        allowed = turn.allowed[i]
        if allowed is not None and len(allowed) == 1:
            values.append(None)
        elif allowed is not None:
            values.append(scores[token] - torch.logsumexp(scores[list(allowed)], 0))
        else:
            values.append(scores[token] - torch.logsumexp(scores, 0))
    return values


def sample_std(values: Sequence[float]) -> float:
    mean = sum(values) / len(values)
    return math.sqrt(sum((v - mean) ** 2 for v in values) / (len(values) - 1)) if len(values) > 1 else 0.0


def scaled(values: Sequence[float]) -> list[float]:
    """(x - mean) / (sample deviation + 1e-4); zeros where nothing differs."""
    mean, deviation = sum(values) / len(values), sample_std(values)
    return [(v - mean) / (deviation + 1e-4) if deviation > 1e-6 else 0.0 for v in values]


def reward_to_go(rewards: Sequence[float], t: int) -> float:
    return sum(GAMMA ** (k - t) * r for k, r in enumerate(rewards) if k >= t)


def group_advantages(name: str, members: Sequence[Rollout]) -> list[list[float]]:
    """Per scorable rollout and step its advantage."""
    returns = [sum(m.rewards) for m in members]
    n, mean = len(returns), sum(returns) / len(returns)
    togo = [[reward_to_go(m.rewards, t) for t in range(len(m.rewards))] for m in members]
    if name == "reward_to_go":
        longest = max(map(len, togo))
        base = [sum(g[t] for g in togo if len(g) > t) / n for t in range(longest)]
        deviation = sample_std([v - base[t] for g in togo for t, v in enumerate(g)])
        return [
            [(v - base[t]) / (deviation + 1e-4) if deviation > 1e-6 else 0.0 for t, v in enumerate(g)] for g in togo
        ]
    if name == "gigpo":
        result = [[a] * len(m.rewards) for a, m in zip(scaled(returns), members, strict=True)]
        for state in {s for m in members for s in m.states}:
            met = [(i, t) for i, m in enumerate(members) for t, s in enumerate(m.states) if s == state]
            for (i, t), extra in zip(met, scaled([togo[i][t] for i, t in met]), strict=True):
                result[i][t] += WEIGHT * extra
        return result
    single = {
        "grpo": scaled(returns),
        "centred": [r - mean for r in returns],
        "rloo": [r - sum(returns[:i] + returns[i + 1 :]) / (n - 1) for i, r in enumerate(returns)],
        "max_rl": [(r - mean) / mean for r in returns],
    }[name]
    return [[a] * len(m.rewards) for a, m in zip(single, members, strict=True)]


@dataclass(frozen=True)
class Token:
    """A trained token: log-probability now, as recorded, under the reference, its advantage and its sequence."""

    logp: torch.Tensor
    old: float
    reference: float
    advantage: float
    row: tuple[int, int]


def trained_tokens(model: Any, base: Any, batch: Sequence[Rollout], config: dict[str, Any]) -> list[Token]:
    """Every token that the update trains."""
    overlong = config.get("overlong", "mask")
    tokens = []
    for start in range(0, len(batch), GROUP):
        places = [i for i in range(start, start + GROUP) if not batch[i].failed]
        places = [i for i in places if not (batch[i].overlong and overlong == "drop")]
        advantages = group_advantages(config["estimator"], [batch[i] for i in places])
        if config.get("skip_zero_variance") and not any(a for row in advantages for a in row):
            continue
        for i, steps in zip(places, advantages, strict=True):
            if batch[i].overlong and overlong == "mask":
                continue
            for turn in (t for t in batch[i].turns if t.step < len(steps)):
                with torch.no_grad():
                    fixed = token_logprobs(base, turn)
                for value, old, ref in zip(token_logprobs(model, turn), turn.recorded, fixed, strict=True):
                    if value is not None and ref is not None:
                        tokens.append(Token(value, old, float(ref), steps[turn.step], (i, turn.sequence)))
    return tokens


def token_loss(name: str, t: Token) -> torch.Tensor:
    ratio = torch.exp(t.logp - t.old)
    if name == "cispo":
        return -ratio.detach().clamp(max=HIGH) * t.advantage * t.logp
    if name == "dppo":
        moved = float(ratio.detach()) * math.exp(t.old) - math.exp(t.old)
        outside = moved > HIGH if t.advantage > 0 else moved < -LOW if t.advantage < 0 else False
        return t.logp * 0.0 if outside else -ratio * t.advantage
    return -torch.minimum(ratio * t.advantage, ratio.clamp(1 - LOW, 1 + HIGH) * t.advantage)


def oracle_loss(tokens: Sequence[Token], config: dict[str, Any], rollouts: int) -> torch.Tensor:
    """The loss of the update."""
    name, beta = config["loss_type"], config.get("beta", 0.0)
    rows = sorted({t.row for t in tokens})
    losses = []
    for t in tokens:
        value = token_loss(name, t)
        if config.get("normalize") == "rollout":  # N / (R n): R rollouts, n trained tokens of this one
            own = sum(o.row[0] == t.row[0] for o in tokens)
            value = value * len(tokens) / (len({row[0] for row in rows}) * own)
        if beta:
            gap = t.reference - t.logp
            weight = torch.exp(t.logp - t.old) if config.get("use_bias_correction_kl", True) else 1.0
            value = value + beta * weight * (torch.exp(gap) - gap - 1)
        losses.append(value)
    if name == "grpo":
        means: list[torch.Tensor] = []
        for row in rows:
            means.append(torch.stack([v for v, t in zip(losses, tokens, strict=True) if t.row == row]).mean())
        return torch.stack(means).mean()
    return torch.stack(losses).sum() / (rollouts * LENGTH if name == "dr_grpo" else len(tokens))


# --- the trainer on the same episodes --------------------------------------------------------------------------------


def trajectory(rollout: Rollout, number: int) -> Any:
    """The rollout as an episode of the scaffold records it."""
    from agentspec.trajectory import Trajectory
    from agentspec.types import (
        Action,
        ActionSchema,
        AgentInput,
        CallTag,
        Completion,
        Decision,
        LLMCall,
        Sampling,
        Task,
        Transition,
    )

    calls = tuple(
        LLMCall(
            i,
            CallTag("reasoning.direct", "act", "e", turn.step),
            tuple(turn.prompt),
            (Completion("x", tuple(turn.answer), tuple(turn.recorded), tuple(turn.allowed), "stop", "executed"),),
            Sampling(temperature=turn.temperature),
        )
        for i, turn in enumerate(rollout.turns)
    )
    steps = tuple(
        Transition(t, AgentInput("go", state, ActionSchema({})), Decision(Action("A", text="A()")), "A()", reward, "")
        for t, (state, reward) in enumerate(zip(rollout.states, rollout.rewards, strict=True))
    )
    return Trajectory(
        Task("toy", number // GROUP),
        {},
        number % GROUP,
        transitions=steps,
        calls=calls,
        metrics={"ended": "context" if rollout.overlong else "environment"},
        status="failed" if rollout.failed else "completed",
    )


def trainer_gradients(model: Any, batch: Sequence[Rollout], config: dict[str, Any]) -> dict[str, torch.Tensor]:
    """Gradients as they reach the optimiser."""
    from datasets import Dataset
    from transformers import TrainerCallback

    from agentspec.types import Task
    from trainers.config import ScaffoldConfig
    from trainers.credit import ScoredEpisode
    from trainers.grpo import ScaffoldGRPOTrainer
    from trainers.rollouts import task_rows

    found: dict[str, torch.Tensor] = {}

    class Keep(TrainerCallback):
        def on_pre_optimizer_step(self, args: Any, state: Any, control: Any, **kwargs: Any) -> None:
            named = kwargs["model"].named_parameters()
            found.update({n: p.grad.clone() for n, p in named if p.grad is not None})

    def play(runner: Any, jobs: Any, rewards: Any, **_: Any) -> list[Any]:
        episodes = [trajectory(r, i) for i, r in enumerate(batch)]
        return [ScoredEpisode(t, rewards.score(t)) for t in episodes]

    # A loss that looks at micro-batches one by one is defined by one of them; the others are split in as many as need
    # padding.
    parts = 1 if config["loss_type"] == "bnpo" else 3
    with tempfile.TemporaryDirectory() as folder, patch("trainers.grpo.collect", play):
        settings = ScaffoldConfig(
            output_dir=folder,
            per_device_train_batch_size=GROUP * GROUPS // parts,
            gradient_accumulation_steps=parts,
            num_generations=GROUP,
            num_iterations=2,  # the update reads the recorded log-probabilities as the old ones
            max_steps=1,
            learning_rate=1e-6,
            max_grad_norm=0.0,
            epsilon=LOW,
            epsilon_high=HIGH,
            rewards={"env": 1.0},
            report_to=[],
            use_cpu=True,
            bf16=False,
            save_strategy="no",
            disable_tqdm=True,
            shuffle_dataset=False,
            **(read_by(config) | config),
        )
        settings.logging_strategy = "no"
        trainer = ScaffoldGRPOTrainer(
            model,
            settings,
            train_dataset=Dataset.from_list(task_rows([Task("toy", i) for i in range(GROUPS)])),
            processing_class=tiny_tokenizer(),
            make_llm=lambda *_: _NoModel(),  # type: ignore[arg-type]  # nobody asks it
            callbacks=[Keep()],
        )
        with contextlib.redirect_stdout(io.StringIO()):  # the summary that transformers prints
            trainer.train()
    return found


def read_by(config: dict[str, Any]) -> dict[str, Any]:
    """Settings that only this loss and estimator read."""
    length = {"max_completion_length": LENGTH} if config["loss_type"] == "dr_grpo" else {}
    discount = {"gamma": GAMMA} if config["estimator"] in ("reward_to_go", "gigpo") else {}
    return length | discount | ({"gigpo_weight": WEIGHT} if config["estimator"] == "gigpo" else {})


class _NoModel:
    """Stands where the backend would: the episodes are given."""


def tiny_tokenizer() -> Any:
    from tokenizers import Tokenizer, models
    from transformers import PreTrainedTokenizerFast

    vocabulary = {f"t{i}": i for i in range(128)}
    return PreTrainedTokenizerFast(
        tokenizer_object=Tokenizer(models.WordLevel(vocabulary, unk_token="t0")), pad_token="t1", eos_token="t2"
    )


def tiny_policy(lora: bool) -> tuple[Any, Any]:
    """A random model (with an adapter, away from its base), and its base."""
    from transformers import Qwen3Config, Qwen3ForCausalLM

    torch.manual_seed(0)
    base = Qwen3ForCausalLM(
        Qwen3Config(
            vocab_size=128,
            hidden_size=32,
            intermediate_size=64,
            num_hidden_layers=2,
            num_attention_heads=4,
            num_key_value_heads=2,
            head_dim=8,
            max_position_embeddings=256,
            initializer_range=0.3,  # distributions that are far from uniform
            pad_token_id=1,
            eos_token_id=2,
        )
    )
    if not lora:
        return base, base
    from peft import LoraConfig, get_peft_model

    config = LoraConfig(r=2, lora_alpha=8, target_modules=["q_proj", "v_proj"], init_lora_weights=False)
    return get_peft_model(copy.deepcopy(base), config), base


def cases() -> Iterator[dict[str, Any]]:
    """Every loss with every estimator and packing; what else changes numbers, once per loss or estimator."""
    from trainers.estimators import ESTIMATORS
    from trainers.losses import LOSSES

    packings: list[dict[str, Any]] = [{"packing": "tree"}, {"packing": "padded"}]
    for loss, estimator, packing in product(LOSSES, ESTIMATORS, packings):
        yield {"loss_type": loss, "estimator": estimator, **packing}
    for loss, spec in LOSSES.items():
        plain = {"loss_type": loss, "estimator": "grpo"}
        yield plain | {"packing": "tree", "tokens_per_forward": 40}
        yield plain | {"packing": "padded", "tokens_per_forward": 40}
        yield plain | {"packing": "tree", "beta": BETA, "reference": "base"}
        yield plain | {"packing": "padded", "beta": BETA, "reference": "base", "use_bias_correction_kl": False}
        if spec.per_token:
            yield plain | {"packing": "tree", "normalize": "rollout"}
    for estimator, overlong in product(ESTIMATORS, ("keep", "drop")):
        yield {"loss_type": "dapo", "estimator": estimator, "packing": "tree", "overlong": overlong}
    for estimator in ESTIMATORS:
        yield {"loss_type": "dapo", "estimator": estimator, "packing": "tree", "skip_zero_variance": True}


def relative_error(config: dict[str, Any], seed: int = 0) -> float:
    """Norm of the difference of the two gradients over that of the oracle's."""
    model, base = tiny_policy(lora="beta" in config)
    exact, fixed = copy.deepcopy(model).double(), copy.deepcopy(base).double()
    batch = make_batch(exact, seed)
    tokens = trained_tokens(exact, fixed, batch, config)
    oracle_loss(tokens, config, len(batch)).backward()
    expected = {n: p.grad for n, p in exact.named_parameters() if p.grad is not None}
    found = trainer_gradients(model, batch, config)
    if found.keys() != expected.keys():
        raise AssertionError(f"gradients of other parameters: {sorted(found.keys() ^ expected.keys())[:4]}")
    difference = sum(float((found[n].double() - g).square().sum()) for n, g in expected.items())
    return math.sqrt(difference / sum(float(g.square().sum()) for g in expected.values()))


def main() -> None:
    """Run every case and print the worst, or all as JSON."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    named = {" ".join(f"{k}={v}" for k, v in config.items()): config for config in cases()}
    errors = {name: relative_error(c, options.seed) for name, c in named.items() if options.only in name}
    worst = max(errors.values())
    if options.json:
        print(json.dumps({"cases": len(errors), "worst_rel_error": worst, "by_case": errors}))
        return
    for name, error in sorted(errors.items(), key=lambda item: -item[1])[:10]:
        print(f"{error:.1e}  {name}")
    print(f"{len(errors)} cases, worst relative error {worst:.1e}")


if __name__ == "__main__":
    main()
