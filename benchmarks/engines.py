"""Our engine beside engines a user could take instead: the same turns of the same episodes, to the token.

    python -m benchmarks.engines [--json] [--server llama.cpp=http://127.0.0.1:8080 vllm=http://127.0.0.1:8000]

Episodes of a small text world (`benchmarks.market`) are played once by our engine, greedily, with answers of exactly
`--answer` tokens, and recorded as token ids. Then every engine gets the recorded prompts, episode by episode, each turn
when the one before is answered, and all episodes at once: ours in this process, others by HTTP, on a machine that does
nothing else. A prompt holds what the recording answered before, which is what an engine with the same weights has just
written; `same_answers` is the share of answers that are. Prompts of one replay begin with a token that no other's do,
so that no cache knows them, ours included.

- `seconds`: the whole replay; `ratio`: that of this engine over ours.
- `prefill_tokens_per_s`: of a second replay whose answers have one token. Tokens are those of all prompts that are to
  be read at least: what prompts share counts once, what the engine wrote itself does not.
- `decode_tokens_per_s`: the other tokens of the answers, over the difference of the two replays.

Engines take turns in every repeat, medians are reported. `--json` prints `episodes`, `turns`, `answer`, `prompt_tokens`
(to be read at least, in either replay) and `engines`: name -> the keys above and `prefill_seconds`.

A server is anything with OpenAI's `/v1/completions` that takes token ids as a prompt. In environments of their own,
for the bundled model in float32 on two cores (`FOLDER`: `agentspec.llm.models.resolve`; the GGUF file:
`python -m benchmarks.gguf_float32`):

    llama-server -m smollm2-135m-f32.gguf -t 2 -np 8 -c 32768 -ctk f32 -ctv f32 -fa off --port 8080
    VLLM_CPU_KVCACHE_SPACE=4 vllm serve FOLDER --dtype float32 --max-model-len 4096 --port 8000

Without `-fa off`, llama.cpp's log-probabilities were off by up to 2.5e-3 on a CPU in float32, with it by 1.7e-4.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import sys
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

from agentspec.cli.errors import expected_errors
from agentspec.llm.base import LLMError
from agentspec.tokens import shared_prefix
from benchmarks.rollouts import FixedLengthLLM, agent_spec, load_model, tiny

OURS = "agentspec"
FIRST_SALT = 200
"""Id of the token that the first replay's prompts begin with; each later replay takes the next."""


@dataclass(frozen=True)
class Turn:
    """A prompt and what the recording answered."""

    prompt: tuple[int, ...]
    answer: tuple[int, ...]


Recording = list[list[Turn]]
"""Episodes of turns."""


class Engine(Protocol):
    """Something that continues prompts."""

    def fresh(self) -> None:
        """Before a replay."""

    def complete(self, episode: str, prompt: Sequence[int], tokens: int) -> Awaitable[str]:
        """The text of exactly `tokens` greedy tokens after `prompt`, none of which ends a turn."""


class Ours:
    """The local backend in this process, its answers greedy and of a fixed length."""

    def __init__(self, model: Any, tokenizer: Any) -> None:
        self.llm = FixedLengthLLM(model.eval(), tokenizer, 1)
        self.salt: int | None = None
        engine, chat, ends = self.llm._engine, self.llm.chat, sorted(self.llm.stop_ids)
        packed, advance, render = engine.model, engine._advance, chat.render
        forward = packed.forward

        def masked(segments: Any) -> Any:
            outputs = forward(segments)
            for logits in outputs:
                logits[:, ends] = float("-inf")
            return outputs

        def unending(step: Any) -> None:  # only here: the model is also asked whether it computes correctly
            packed.forward = masked  # type: ignore[method-assign]
            try:
                advance(step)
            finally:
                packed.forward = forward  # type: ignore[method-assign]

        engine._advance = unending  # type: ignore[method-assign]
        chat.render = lambda messages: [self.salt, *render(messages)]  # type: ignore[method-assign]

    def fresh(self) -> None:
        """Forget what was read."""
        self.llm._engine.cache.clear()

    async def complete(self, episode: str, prompt: Sequence[int], tokens: int) -> str:
        """As `Engine`'s."""
        from agentspec.llm.local.rows import Job
        from agentspec.types import Sampling

        job = Job(episode, list(prompt), Sampling(temperature=0.0, max_tokens=tokens))
        await self.llm._submit(0, job)
        return job.completions[0].text


class Server:
    """A server with OpenAI's completions."""

    def __init__(self, url: str, logprobs: bool) -> None:
        from agentspec.llm.openai import import_httpx

        self._httpx, self._url, self._logprobs = import_httpx(), url.rstrip("/"), logprobs
        try:
            self._model = str(self._httpx.get(f"{self._url}/v1/models", timeout=10).json()["data"][0]["id"])
        except (self._httpx.HTTPError, ValueError, LookupError, TypeError) as error:
            raise LLMError(f"{url}/v1/models names no model ({error!r}); start the server or mend --server") from None

    def fresh(self) -> None:
        """A connection for every episode."""
        limits = self._httpx.Limits(max_connections=None)
        self._client = self._httpx.AsyncClient(timeout=3600, limits=limits)

    async def complete(self, episode: str, prompt: Sequence[int], tokens: int) -> str:
        """As `Engine`'s. `min_tokens` is vLLM's way to forbid an end, `ignore_eos` llama.cpp's."""
        body = {
            "model": self._model,
            "prompt": list(prompt),
            "max_tokens": tokens,
            "min_tokens": tokens,
            "ignore_eos": True,
            "temperature": 0.0,
            "cache_prompt": True,
        } | ({"logprobs": 1} if self._logprobs else {})
        response = await self._client.post(f"{self._url}/v1/completions", json=body)
        if response.status_code != 200:
            raise LLMError(
                f"{self._url}: status {response.status_code}: {response.text[:300]}; the server has to take token ids "
                "as a prompt, and its context must hold the last turn (see `--turns`)"
            )
        answer = response.json()
        written = answer["usage"]["completion_tokens"]
        if written != tokens:
            raise LLMError(
                f"{self._url} wrote {written} tokens where {tokens} were asked for: it knows neither `ignore_eos` nor "
                "`min_tokens`, or its context is full"
            )
        return str(answer["choices"][0]["text"])


def record(ours: Ours, world: dict[str, Any], episodes: int, answer: int, salt: int) -> Recording:
    """What our engine reads and greedily writes in `episodes` of the market, each another task."""
    from agentspec.episode import Job, Runner
    from agentspec.spec import AgentSpec
    from agentspec.types import Task
    from benchmarks.market import MARKET

    ours.fresh()
    ours.salt, ours.llm.answer = salt, answer
    spec = AgentSpec.from_data(agent_spec().to_data() | {"sampling": {"temperature": 0.0}})
    played = Runner(spec, ours.llm).run([Job(Task(MARKET, seed, world)) for seed in range(episodes)])
    for episode in played:
        if episode.error or len(episode.calls) != world["steps"]:
            raise RuntimeError(f"an episode did not take {world['steps']} turns: {episode.error}")
    return [[Turn(tuple(c.prompt_ids), tuple(c.completions[0].token_ids)) for c in e.calls] for e in played]


async def replay(engine: Engine, recording: Recording) -> tuple[float, list[list[str]]]:
    """Every episode's prompts in turn, all episodes at once: seconds, and the answers."""

    async def play(number: int, turns: list[Turn]) -> list[str]:
        if isinstance(engine, Ours):
            engine.llm.enter(str(number))
        try:
            return [await engine.complete(str(number), t.prompt, len(t.answer)) for t in turns]
        finally:
            if isinstance(engine, Ours):
                engine.llm.leave(str(number))

    engine.fresh()
    start = time.perf_counter()
    answers = await asyncio.gather(*(play(i, turns) for i, turns in enumerate(recording)))
    return time.perf_counter() - start, list(answers)


def least_read(recording: Recording) -> int:
    """Prompt tokens that have to be read: what prompts share once, and nothing that was written in the replay."""
    last = sorted(turns[-1].prompt for turns in recording)
    shared = sum(shared_prefix(a, b) for a, b in pairwise(last))
    return sum(map(len, last)) - shared - sum(len(t.answer) for turns in recording for t in turns[:-1])


def share_same(answers: list[list[str]], recording: Recording, decode: Callable[[Sequence[int]], str]) -> float:
    """Share of the answers that are those of the recording, as text."""
    given = [answer.strip() for row in answers for answer in row]
    expected = [decode(turn.answer).strip() for turns in recording for turn in turns]
    return sum(a == b for a, b in zip(given, expected, strict=True)) / len(expected)


def measure(engines: dict[str, Engine], ours: Ours, options: argparse.Namespace) -> dict[str, Any]:
    """All engines in turn, `options.repeats` times: every replay with answers of full length, and of one token."""
    world = {"steps": options.turns, "words": options.words}
    salts = iter(range(FIRST_SALT, 1 << 30))
    runs: dict[str, list[tuple[float, float, float]]] = {name: [] for name in engines}
    for _ in range(options.repeats):
        whole, short = (record(ours, world, options.rollouts, n, next(salts)) for n in (options.answer, 1))
        for name, engine in engines.items():
            seconds, answers = asyncio.run(replay(engine, whole))
            reading, _ = asyncio.run(replay(engine, short))
            runs[name].append((seconds, reading, share_same(answers, whole, ours.llm._decode)))
            print(f"  {name} {seconds:.2f} s, answers of one token {reading:.2f} s", file=sys.stderr, flush=True)
    tokens, further = least_read(short), options.rollouts * options.turns * (options.answer - 1)
    result = {}
    for name, rows in runs.items():
        seconds, reading, same = (statistics.median(column) for column in zip(*rows, strict=True))
        result[name] = {
            "seconds": seconds,
            "prefill_seconds": reading,
            "prefill_tokens_per_s": tokens / reading,
            "decode_tokens_per_s": further / (seconds - reading) if seconds > reading else None,
            "same_answers": same,
        }
    for r in result.values():
        r["ratio"] = r["seconds"] / result[OURS]["seconds"]
    return {"engines": result, "prompt_tokens": tokens}


def servers(given: Sequence[str], logprobs: bool) -> dict[str, Engine]:
    """`NAME=URL` -> engine by name."""
    found: dict[str, Engine] = {}
    for text in given:
        name, separator, url = text.partition("=")
        if not separator or not url.startswith("http") or name in found or name == OURS:
            raise LLMError(f"--server {text!r}: expected NAME=URL, names that differ (and from {OURS!r}), http://...")
        found[name] = Server(url, logprobs)
    return found


def main() -> None:
    """Measure and print a table, or JSON."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--model", default="smollm2-135m", help="`tiny`: a random one, for a try")
    parser.add_argument("--server", nargs="*", default=[], metavar="NAME=URL", help="with the same weights")
    parser.add_argument("--logprobs", action="store_true", help="ask servers for log-probabilities, which ours gives")
    parser.add_argument("--rollouts", type=int, default=8, help="episodes, all at once")
    parser.add_argument("--turns", type=int, default=8)
    parser.add_argument("--answer", type=int, default=8, help="tokens written per turn, at least 2")
    parser.add_argument("--words", type=int, default=100, help="words of news in an observation")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.answer < 2:
        parser.error(f"--answer is {options.answer}: decode is measured from the second token on; give at least 2")
    others = servers(options.server, options.logprobs)
    ours = Ours(*(tiny() if options.model == "tiny" else load_model(options.model)))
    engines: dict[str, Engine] = {OURS: ours, **others}
    once = record(ours, {"steps": 1, "words": options.words}, 1, 2, FIRST_SALT - 1)
    for engine in engines.values():  # what each does once: compiling, allocating, checking its own arithmetic
        asyncio.run(replay(engine, once))
    result = measure(engines, ours, options)
    if options.json:
        print(json.dumps({"episodes": options.rollouts, "turns": options.turns, "answer": options.answer} | result))
        return
    print(f"{options.rollouts} episodes of {options.turns} turns, {result['prompt_tokens']} prompt tokens at least")
    for name, r in result["engines"].items():
        decode = r["decode_tokens_per_s"]
        print(
            f"{name:<12} {r['seconds']:7.2f} s  {r['ratio']:5.2f}x  prefill {r['prefill_tokens_per_s']:7.0f} tokens/s  "
            f"decode {'unknown' if decode is None else f'{decode:7.1f} tokens/s'}  same answers {r['same_answers']:.0%}"
        )


if __name__ == "__main__":
    with expected_errors():
        main()
