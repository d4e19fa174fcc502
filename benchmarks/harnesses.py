"""Evaluation throughput beside Inspect AI and verifiers: the same episodes against the same endpoint on loopback.

    python -m benchmarks.harnesses [--json] [--python inspect=PATH verifiers=PATH]

An endpoint that answers every chat completion at once with the same legal action; episodes of a MiniGrid level that
such an answer never ends, so that every harness makes the same calls, `--steps` per episode, `--concurrency` episodes
at once, each as a growing conversation. Every harness writes its own full record.

- `agentspec`: `agentspec eval` with the scaffold `direct` in the layout `conversation`;
- `inspect`: Inspect AI's `eval`, with a solver that plays the world through Inspect's model API (`play_in_inspect`);
- `verifiers`: `vf-eval` with our taskset and verifiers' own chat loop (`null`; it needs `uv` and starts a process per
  episode: fewer episodes, `SLOW`);
- `verifiers+agentspec`: `vf-eval` with our scaffold in verifiers' seat.

Each command runs with `--few` and with `--many` episodes; figures are of the difference, so that starting up counts for
nobody and stands beside. Processor time is of the harness's process and its children, without the endpoint. A harness
that is not installed is skipped; `--python` names the interpreter that has it.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

WORLD = "minigrid"
ANSWER = "turn left"
SEED = 20_000
SCAFFOLD = {"reasoning": "direct", "layout": "conversation", "sampling": {"max_tokens": 16}}
NAMES = ("agentspec", "inspect", "verifiers", "verifiers+agentspec")
SLOW = {"verifiers": (2, 10)}
"""Few and many episodes of a harness that starts a process per episode."""
NEEDS = {"inspect": "inspect_ai, openai", "verifiers": "verifiers.v1"}


@dataclass(frozen=True)
class Load:
    """What is played."""

    url: str
    episodes: int
    steps: int
    concurrency: int

    @property
    def options(self) -> dict[str, Any]:
        """Of the environment."""
        level = "MiniGrid-Empty-8x8-v0"
        return {"level": level, "observation": "compact", "action_mode": "menu", "max_steps": self.steps}


# -- the endpoint ----------------------------------------------------------------------------------


def serve(ports: Any, calls: Any) -> None:
    """Answers chat completions; its port goes to `ports`, `calls` counts them."""

    async def client(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while head := await reader.readuntil(b"\r\n\r\n"):
                lines = head.decode("latin-1").lower().splitlines()
                length = next((int(x.partition(":")[2]) for x in lines if x.startswith("content-length:")), 0)
                body = json.loads(await reader.readexactly(length) or b"{}")
                calls.value += lines[0].startswith("post")
                kind, payload = answer(body)
                head_out = f"HTTP/1.1 200 OK\r\nContent-Type: {kind}\r\nContent-Length: {len(payload)}\r\n\r\n"
                writer.write(head_out.encode() + payload)
                await writer.drain()
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            writer.close()

    async def run() -> None:
        server = await asyncio.start_server(client, "127.0.0.1", 0)
        ports.put(server.sockets[0].getsockname()[1])
        await server.serve_forever()

    asyncio.run(run())


def answer(body: dict[str, Any]) -> tuple[str, bytes]:
    """Content type and body of a completion, streamed where that was asked for."""
    base = {"id": "c", "created": 0, "model": body.get("model", "stub")}
    usage = {"prompt_tokens": 100, "completion_tokens": 3, "total_tokens": 103}
    message = {"role": "assistant", "content": ANSWER}
    if not body.get("stream"):
        choices = [{"index": 0, "message": message, "finish_reason": "stop"}]
        whole = base | {"object": "chat.completion", "choices": choices, "usage": usage}
        return "application/json", json.dumps(whole).encode()
    base["object"] = "chat.completion.chunk"
    first = base | {"choices": [{"index": 0, "delta": message, "finish_reason": None}]}
    last = base | {"choices": [{"index": 0, "delta": {}, "finish_reason": "stop"}], "usage": usage}
    chunks = "".join(f"data: {json.dumps(c)}\n\n" for c in (first, last))
    return "text/event-stream", (chunks + "data: [DONE]\n\n").encode()


# -- the harnesses ---------------------------------------------------------------------------------


def agentspec_command(python: str, load: Load, folder: Path) -> list[str]:
    """`agentspec eval` of one policy in one scaffold."""
    policy = {"model": "stub", "backend": "openai", "base_url": load.url, "max_concurrency": load.concurrency}
    seeds = f"{SEED}-{SEED + load.episodes - 1}"
    matrix = {
        "policies": {"stub": policy},
        "scaffolds": {"direct": SCAFFOLD},
        "tasks": {"grid": {"env": WORLD, "options": load.options, "seeds": seeds}},
        "trajectories": True,
        "concurrency": load.concurrency,
    }
    config = folder / "matrix.yaml"
    config.write_text(json.dumps(matrix))
    return [python, "-m", "agentspec.cli", "eval", "--config", str(config), "--out", str(folder / "out")]


def inspect_command(python: str, load: Load, folder: Path) -> list[str]:
    """This module as a child, which calls Inspect."""
    return [python, "-m", "benchmarks.harnesses", "--in-inspect", str(folder), json.dumps(vars(load))]


def verifiers_command(python: str, load: Load, folder: Path, *, seat: bool = False) -> list[str]:
    """`vf-eval` with our taskset, and with our scaffold where `seat` says so."""
    program = str(Path(python).with_name("vf-eval"))
    world = ["agentspec-verifiers", "--env.taskset.world", WORLD, "--env.taskset.options", json.dumps(load.options)]
    client = ["--client.base-url", load.url, "--client.api-key-var", "STUB_KEY", "-m", "stub"]
    run = ["-n", str(load.episodes), "-c", str(load.concurrency), "--no-push", "--no-rich", "-o", str(folder)]
    command = [program, *world, "--env.taskset.count", str(load.episodes), *client, *run]
    if not seat:
        return command
    (folder / "agent.yaml").write_text(json.dumps(SCAFFOLD))
    scaffold = ["--env.player.harness.scaffold", str(folder / "agent.yaml")]
    return [*command, "--env.player.harness.id", "agentspec-verifiers", *scaffold]


def play_in_inspect(load: Load, folder: str) -> None:
    """Inspect's own evaluation, with a solver that plays the world in Inspect's loop."""
    from inspect_ai import Task, eval
    from inspect_ai.dataset import Sample
    from inspect_ai.model import ChatMessageSystem, ChatMessageUser, get_model
    from inspect_ai.scorer import Score, mean, scorer
    from inspect_ai.solver import solver

    from agentspec.interop.game import Game
    from agentspec.prompting import default_answer, static_prompt
    from agentspec.types import AgentInput

    @solver
    def world() -> Any:
        async def solve(state: Any, generate: Any) -> Any:
            game = Game(WORLD, load.options)
            seen = game.start(int(state.sample_id))
            told = static_prompt(AgentInput(game.instruction, "", game.schema), default_answer(game.schema))
            state.messages = [ChatMessageSystem(content=told)]
            while not game.over:
                state.messages.append(ChatMessageUser(content=seen))
                state.output = await get_model().generate(state.messages)
                state.messages.append(state.output.message)
                seen = game.act(state.output.completion)
            state.metadata["score"] = game.score()
            game.close()
            return state

        return solve

    @scorer(metrics=[mean()])
    def outcome() -> Any:
        async def score(state: Any, target: Any) -> Any:
            return Score(value=state.metadata["score"])

        return score

    samples = [Sample(input="play", id=SEED + i) for i in range(load.episodes)]
    model = get_model("openai/stub", base_url=load.url, api_key="x", responses_api=False)
    limits = {"max_samples": load.concurrency, "max_connections": load.concurrency, "max_tokens": 16}
    [log] = eval(
        Task(dataset=samples, solver=world(), scorer=outcome()), model=model, log_dir=folder, display="none", **limits
    )
    if log.status != "success":
        raise RuntimeError(f"Inspect's evaluation ended with {log.status}: {log.error}")


# -- measuring -------------------------------------------------------------------------------------


def run(command: Sequence[str]) -> tuple[float, float]:
    """Wall-clock and processor seconds of a command and its children.

    Raises:
        RuntimeError: it failed.
    """
    path = f"{Path(command[0]).parent}:{os.environ['PATH']}"
    environment = os.environ | {"STUB_KEY": "x", "OPENAI_API_KEY": "x", "PATH": path}
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)[:200]} failed:\n{done.stdout[-1500:]}\n{done.stderr[-1500:]}")
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure(
    command: Callable[[Load, Path], list[str]], url: str, sizes: tuple[int, int], options: Any, calls: Any
) -> dict[str, float]:
    """Figures of one harness, from the difference between many episodes and few.

    Raises:
        RuntimeError: it made other calls than one per step.
    """
    seconds = []
    for episodes in sizes:
        calls.value = 0
        with tempfile.TemporaryDirectory() as folder:
            seconds.append(run(command(Load(url, episodes, options.steps, options.concurrency), Path(folder))))
        if calls.value != episodes * options.steps:
            raise RuntimeError(f"{calls.value} calls for {episodes} episodes of {options.steps} steps; no comparison")
    (few_wall, few_cpu), (many_wall, many_cpu) = seconds
    more, wall, cpu = sizes[1] - sizes[0], many_wall - few_wall, many_cpu - few_cpu
    return {
        "episodes_per_s": more / wall,
        "steps_per_s": more * options.steps / wall,
        "cpu_ms_per_step": 1e3 * cpu / (more * options.steps),
        "start_s": few_wall - sizes[0] * wall / more,
    }


def main() -> None:
    """All harnesses that are installed; a table or JSON."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    sizes = (("--steps", 20, "of an episode"), ("--few", 8, "episodes"), ("--many", 136, "episodes"))
    for name, default, what in (*sizes, ("--concurrency", 16, "episodes at once")):
        parser.add_argument(name, type=int, default=default, help=f"{what} (default: %(default)s)")
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES, help="harnesses")
    parser.add_argument("--python", nargs="+", default=[], metavar="NAME=PATH", help="interpreters of harnesses")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--in-inspect", nargs=2, metavar=("DIR", "LOAD"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.in_inspect:
        play_in_inspect(Load(**json.loads(options.in_inspect[1])), options.in_inspect[0])
        return
    pythons = dict(text.split("=", 1) for text in options.python)
    commands: dict[str, Callable[..., list[str]]] = {
        "agentspec": agentspec_command,
        "inspect": inspect_command,
        "verifiers": verifiers_command,
        "verifiers+agentspec": lambda *given: verifiers_command(*given, seat=True),
    }
    spawn = multiprocessing.get_context("spawn")
    ports, calls = spawn.Queue(), spawn.Value("q", 0)
    server = spawn.Process(target=serve, args=(ports, calls), daemon=True)
    server.start()
    url, found, skipped = f"http://127.0.0.1:{ports.get(timeout=60)}/v1", {}, {}
    for name in options.only:
        kind = name.partition("+")[0]
        python = pythons.get(kind, sys.executable)
        needs = NEEDS.get(kind, "agentspec")
        if subprocess.run([python, "-c", f"import {needs}"], capture_output=True, check=False).returncode:
            skipped[name] = f"{python} has no {needs}"
            continue
        command = commands[name]
        sizes = SLOW.get(name, (options.few, options.many))
        found[name] = measure(lambda *at, c=command, p=python: c(p, *at), url, sizes, options, calls)
    server.terminate()
    show(found, skipped, options)


def show(found: dict[str, dict[str, float]], skipped: dict[str, str], options: Any) -> None:
    """Print the figures and the ratio of each harness's processor time to ours."""
    ours = found.get("agentspec", {})
    for row in found.values() if ours else ():
        row["times_our_steps_per_s"] = row["steps_per_s"] / ours["steps_per_s"]
        row["times_our_cpu"] = row["cpu_ms_per_step"] / ours["cpu_ms_per_step"]
    what = f"{WORLD}, {options.steps} steps an episode, {options.concurrency} at once, {options.few} -> {options.many}"
    if options.json:
        print(json.dumps({"what": what, "load": os.getloadavg()[0], "harnesses": found, "skipped": skipped}))
        return
    print(f"Episodes of {what} episodes, an endpoint on loopback that answers at once; load {os.getloadavg()[0]:.1f}")
    for name, r in found.items():
        times = f"{r['times_our_steps_per_s']:.2f}x, CPU {r['times_our_cpu']:.2f}x" if ours else ""
        print(
            f"{name:<20} {r['episodes_per_s']:6.2f} episodes/s {r['steps_per_s']:7.1f} steps/s "
            f"{r['cpu_ms_per_step']:6.2f} ms CPU/step, start {r['start_s']:.1f} s  {times}"
        )
    for name, why in skipped.items():
        print(f"{name:<20} skipped: {why}")


if __name__ == "__main__":
    main()
