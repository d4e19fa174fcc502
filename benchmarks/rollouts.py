"""Rollouts: ours beside stock TRL's, the same work on both sides.

    python -m benchmarks.rollouts [--json] [--turns 4 8 16] [--rollouts 8] [--repeats 3]

Both sides play the same tasks with the same model and tokenizer: the same system text and observations (about 120
tokens, as in the quick-start), the same number of turns, and exactly ``--answer`` sampled tokens per turn (no stop
strings, no end of turn). Ours is :class:`~agentspec.episode.Runner` over the local backend with an empty cache; TRL's
is ``GRPOTrainer`` with ``environment_factory``, whose parser sees a tool call in every turn. Timed is generation with
the environments' steps (for TRL ``_generate``, without making and resetting its environments); A B A B in one process,
the median is reported. TRL's last tool call is not executed: it steps its environments once less.

``utilisation`` is how much of the machine our side used while it read prompts (prefill) and while it wrote (decode):
the least time of the same forwards at the ceilings measured in the same run, over the processor time they took,
sampling included (`benchmarks.phases`). With ``--json`` every number of turns has ``ours_s``, ``trl_s`` and ``ratio``
(medians), ``tokens`` and ``trl_tokens`` (of all conversations), and ``prefill`` and ``decode``, each with ``forwards``,
``tokens``, ``seconds``, ``tokens_per_s``, ``cpu_s`` (per thread; all repeats together) and ``utilisation``.

``slow_env_ratio`` compares 32 rollouts in environments that take 0.1 s a call. There the model is a tiny random one
and answers two tokens, so that environments are what is measured, and TRL makes as many calls as ours (and one more
answer).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from agentspec.llm.local import LocalLLM
from benchmarks.measuring import ceilings
from benchmarks.phases import Phases

CHATML = (
    "{% for m in messages %}<|im_start|>{{ m['role'] }}\n{{ m['content'] }}"
    "{% if m.get('tool_calls') %}{{ m['tool_calls'] | tojson }}{% endif %}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)
"""The same plain template for both sides; tool calls are written out because TRL wants a template that can."""

GROUP = 4


class FixedLengthLLM(LocalLLM):
    """The local backend, except that every answer has exactly ``answer`` tokens."""

    def __init__(self, model: Any, tokenizer: Any, answer: int) -> None:
        super().__init__(model, tokenizer, name="policy", max_cache_tokens=1 << 20)
        self.answer = answer
        self._engine._stop_ids = frozenset()

    async def generate(self, request: Any) -> Any:
        """As the backend's, without anything that ends an answer early."""
        fixed = replace(request.sampling, stop=(), max_tokens=self.answer)
        return await super().generate(replace(request, sampling=fixed))


def agent_spec() -> Any:
    """A plain agent: one call per step, an append-only conversation."""
    from agentspec.spec import AgentSpec

    # Answers of a fixed length are no actions: they are not asked for again.
    reasoning = {"name": "direct", "max_retries": 0}
    return AgentSpec.from_data({"reasoning": reasoning, "layout": "conversation", "sampling": {"temperature": 1.0}})


def market_tasks(rollouts: int, options: dict[str, Any]) -> list[tuple[Any, int]]:
    """(task, rollout) of ``rollouts`` episodes in groups of four."""
    from agentspec.types import Task
    from benchmarks.market import MARKET

    return [(Task(MARKET, i // GROUP, options), i % GROUP) for i in range(rollouts)]


def our_rollouts(
    model: Any, tokenizer: Any, rollouts: int, options: dict[str, Any], answer: int
) -> tuple[Callable[[], tuple[float, int]], Phases]:
    """A function that plays all episodes from an empty cache (seconds, tokens of all conversations), and its phases."""
    from agentspec.episode import Job, Runner

    llm = FixedLengthLLM(model, tokenizer, answer)
    jobs = [Job(task, rollout) for task, rollout in market_tasks(rollouts, options)]
    runner = Runner(agent_spec(), llm)
    # The backend checks its own arithmetic once, before the first batch.
    runner.run([Job(market_tasks(1, {**options, "steps": 1, "delay_s": 0.0})[0][0])])
    phases = Phases(llm)

    def play() -> tuple[float, int]:
        model.eval()
        llm.invalidate()
        start = time.perf_counter()
        episodes = runner.run(jobs)
        seconds = time.perf_counter() - start
        problems = [t.error for t in episodes if t.error or len(t.calls) != options["steps"]]
        if problems:
            raise RuntimeError(f"an episode did not take {options['steps']} turns: {problems[0]}")
        return seconds, sum(len(t.calls[-1].prompt_ids) + answer for t in episodes)

    return play, phases


def system_text(options: dict[str, Any]) -> str:
    """The system text that our agent shows in this world."""
    from agentspec.episode import Job, Runner
    from agentspec.llm.scripted import ScriptedLLM

    seen: list[str] = []

    def script(request: Any) -> str:
        seen.append(request.messages[0].text)
        return "WAIT()"

    Runner(agent_spec(), ScriptedLLM(script)).run([Job(market_tasks(1, {**options, "delay_s": 0.0, "steps": 1})[0][0])])
    return seen[0]


def trl_rollouts(
    model: Any, tokenizer: Any, rollouts: int, options: dict[str, Any], answer: int, calls: int
) -> Callable[[], tuple[float, int]]:
    """The same through stock ``GRPOTrainer``: ``calls`` environment steps per rollout."""
    import torch
    from datasets import Dataset
    from trl import GRPOConfig, GRPOTrainer
    from trl.trainer import grpo_trainer

    from benchmarks.market import MarketEnv

    class Market:
        """TRL's view of the market: ``reset`` gives the first observation, ``act`` is the tool."""

        def __init__(self) -> None:
            self._env = MarketEnv(**options)

        def reset(self, *, seed: int, **_: Any) -> str:
            return str(self._env.reset(seed=seed)[0]["text"])

        def act(self, action: str) -> str:
            """
            Act on the market.

            Args:
                action: what to do.
            """
            return str(self._env.step(action)[0]["text"])

    def parse(tokenizer: Any, ids: Sequence[int], **_: Any) -> dict[str, Any]:
        text = tokenizer.decode(ids)
        call = {"type": "function", "function": {"name": "act", "arguments": {"action": text}}}
        return {"role": "assistant", "content": text, "tool_calls": [call]}

    grpo_trainer.parse_response = parse
    tokenizer.response_template = {}  # known: TRL need not look for one
    prompt = [{"role": "system", "content": system_text(options)}, {"role": "user", "content": ""}]
    rows = [{"prompt": prompt, "seed": task.seed} for task, _ in market_tasks(rollouts, options)]
    trainer = GRPOTrainer(
        model,
        reward_funcs=lambda completions, **_: [0.0] * len(completions),
        args=GRPOConfig(
            output_dir=tempfile.mkdtemp(),
            per_device_train_batch_size=rollouts,
            num_generations=GROUP,
            max_completion_length=1 << 20,
            max_tool_calling_iterations=calls,
            generation_kwargs={"min_new_tokens": answer, "max_new_tokens": answer},
            report_to=[],
            use_cpu=not torch.cuda.is_available(),
            bf16=False,
            gradient_checkpointing=False,
        ),
        train_dataset=Dataset.from_list(rows),
        processing_class=tokenizer,
        environment_factory=Market,
    )
    measured: list[tuple[float, int]] = []
    generate = trainer._generate

    def timed(prompts: Any) -> Any:
        start = time.perf_counter()
        result = generate(prompts)
        measured.append((time.perf_counter() - start, sum(map(len, result[0])) + sum(map(len, result[1]))))
        raise _Generated

    trainer._generate = timed

    def play() -> tuple[float, int]:
        trainer.model.train()
        with contextlib.suppress(_Generated):
            trainer._generate_and_score_completions(list(rows))
        return measured[-1]

    return play


class _Generated(Exception):  # noqa: N818  (no error: the rollouts are done, scoring is not measured)
    """Ends TRL's step after its rollouts."""


def load_model(name: str) -> tuple[Any, Any]:
    """The model in float32, and its tokenizer with the common template."""
    import torch
    from transformers import AutoModelForCausalLM, AutoTokenizer

    from agentspec.llm.models import resolve

    source = resolve(name)
    model = AutoModelForCausalLM.from_pretrained(source.path, dtype=torch.float32)
    tokenizer = AutoTokenizer.from_pretrained(source.path)
    tokenizer.chat_template = CHATML
    return model.to("cuda" if torch.cuda.is_available() else "cpu"), tokenizer


def tiny() -> tuple[Any, Any]:
    """A tiny random model that costs next to nothing."""
    from tests.tiny import tiny_model, tiny_tokenizer

    tokenizer = tiny_tokenizer()
    tokenizer.chat_template = CHATML
    return tiny_model(tokenizer, num_hidden_layers=1, hidden_size=32, intermediate_size=32), tokenizer


def compare(
    ours: Callable[[], tuple[float, int]], trl: Callable[[], tuple[float, int]], repeats: int
) -> dict[str, Any]:
    """Both in turn; medians."""
    mine, theirs = [], []
    for _ in range(repeats):
        mine.append(ours())
        theirs.append(trl())
        print(f"  ours {mine[-1][0]:.2f} s, trl {theirs[-1][0]:.2f} s", file=sys.stderr)
    ours_s, trl_s = (statistics.median(seconds for seconds, _ in runs) for runs in (mine, theirs))
    return {
        "ours_s": ours_s,
        "trl_s": trl_s,
        "ratio": trl_s / ours_s,
        "tokens": mine[-1][1],
        "trl_tokens": theirs[-1][1],
    }


def run_turns(model: Any, tokenizer: Any, turns: int, options: argparse.Namespace) -> dict[str, Any]:
    """One number of turns."""
    world = {"steps": turns, "words": options.words}
    ours, phases = our_rollouts(model, tokenizer, options.rollouts, world, options.answer)
    trl = trl_rollouts(model, tokenizer, options.rollouts, world, options.answer, turns - 1)
    return compare(ours, trl, options.repeats) | phases.summary(ceilings(model.device))


def run_slow(options: argparse.Namespace) -> dict[str, Any]:
    """Environments that take 0.1 s a call."""
    model, tokenizer = tiny()
    world = {"steps": options.slow_turns, "words": 2, "delay_s": 0.1}
    ours, _ = our_rollouts(model, tokenizer, options.slow_rollouts, world, 2)
    trl = trl_rollouts(model, tokenizer, options.slow_rollouts, world, 2, options.slow_turns)
    return compare(ours, trl, options.repeats)


def main() -> None:
    """All numbers of turns and the slow environments; a table or JSON."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--model", default="smollm2-135m")
    parser.add_argument("--turns", type=int, nargs="*", default=[4, 8, 16])
    parser.add_argument("--rollouts", type=int, default=8, help="episodes, in groups of four")
    parser.add_argument("--answer", type=int, default=8, help="sampled tokens per turn")
    parser.add_argument("--words", type=int, default=100, help="words of news in an observation")
    parser.add_argument("--slow-rollouts", type=int, default=32)
    parser.add_argument("--slow-turns", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    results: dict[str, Any] = {}
    if options.turns:
        model, tokenizer = load_model(options.model)
        results = {str(turns): run_turns(model, tokenizer, turns, options) for turns in options.turns}
    slow = run_slow(options) if options.slow_rollouts else None
    if options.json:
        ratio = {"slow_env_ratio": slow["ratio"], "slow_env": slow} if slow else {}
        print(json.dumps(results | ratio))
        return
    for name, r in [*results.items(), *([("slow environments", slow)] if slow else [])]:
        what = name if name.startswith("slow") else f"{name} turns"
        print(
            f"{what:<18} ours {r['ours_s']:7.2f} s  trl {r['trl_s']:7.2f} s  ratio {r['ratio']:6.2f}x  "
            f"{r['tokens']} tokens (trl {r['trl_tokens']}){_used(r)}"
        )


def _used(result: dict[str, Any]) -> str:
    """Speed and utilisation of each phase."""
    parts = [(name, result[name]) for name in ("prefill", "decode") if name in result]
    return "".join(f"  {n} {p['tokens_per_s']:.0f} tokens/s, utilisation {p['utilisation']:.0%}" for n, p in parts)


if __name__ == "__main__":
    main()
