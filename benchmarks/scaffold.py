"""What the scaffold itself costs: a model that answers at once, so that all the time is ours and the environment's.

    python -m benchmarks.scaffold [--json] [--steps 40]

`overhead_ms_per_step`: processor time of an episode per step, less that of the environment alone on the same actions,
for ReAct with Base memory on DeliveryBench. `steps_per_s_64`: steps of 64 episodes at once per second of one core, the
environment included. Processor time (all threads of the process) is what a busy machine cannot inflate; wall-clock
figures stand beside it.
"""

from __future__ import annotations

import argparse
import gc
import json
import time
from collections.abc import Mapping
from typing import Any

from agentspec.envs.making import make_env
from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Completion, LLMCall, Task, Usage

DELIVERY: dict[str, Any] = {"size": "tiny", "shift_hours": 100.0}
WORLDS: dict[str, tuple[str, dict[str, Any], str]] = {
    "deliverybench": ("deliverybench", DELIVERY, "Thought: I wait for orders.\nAction: WAIT(10)"),
    "minigrid": ("minigrid", {}, "Thought: I look around.\nAction: TURN_LEFT()"),
}
SCAFFOLDS: dict[str, dict[str, Any]] = {
    "direct": {"reasoning": "direct"},
    "react+base": {"reasoning": "react", "memory": "base"},
    "react+base, snapshot": {"reasoning": "react", "memory": "base", "layout": "snapshot"},
}


class Instant:
    """A backend that gives the same answer at once, as text, as an endpoint without token ids would."""

    name = "instant"
    max_context = 1_000_000
    capabilities = frozenset({"n"})
    tokenizer = None

    def __init__(self, answer: str) -> None:
        self.answer = answer

    async def generate(self, request: Request) -> LLMCall:
        """The answer."""
        completion = Completion(self.answer, (), (), "stop")
        return LLMCall(request.id, request.tag, (), (completion,), request.sampling, Usage(1000, 20), 0.0, self.name)

    def count_tokens(self, text: str) -> int:
        """An estimate: a token per four characters."""
        return len(text) // 4

    def enter(self, episode: str) -> None:
        """Nothing is kept per episode."""

    def leave(self, episode: str) -> None:
        """Nothing is kept per episode."""


def play(spec: AgentSpec, world: str, episodes: int, steps: int) -> tuple[float, float, list[Trajectory]]:
    """Processor and wall-clock seconds of `episodes` at once, after one to warm up."""
    env, options, answer = WORLDS[world]
    runner = Runner(spec, Instant(answer), max_steps=steps)  # type: ignore[arg-type]  # what an endpoint offers
    runner.run([Job(Task(env, 999, options))])
    gc.collect()
    cpu, wall = time.process_time(), time.perf_counter()
    trajectories = runner.run([Job(Task(env, seed, options)) for seed in range(episodes)])
    return time.process_time() - cpu, time.perf_counter() - wall, trajectories


def alone(trajectory: Trajectory) -> float:
    """Processor seconds of the environment on the actions of an episode, without an agent."""
    env = make_env(trajectory.task)
    cpu = time.process_time()
    env.reset(seed=trajectory.task.seed)
    for transition in trajectory.transitions:
        env.step(transition.action_text)
    return time.process_time() - cpu


def measure(spec: Mapping[str, Any], world: str, steps: int) -> dict[str, float]:
    """Both figures of one scaffold in one world."""
    agent = AgentSpec.from_data(dict(spec))
    cpu, _, [one] = play(agent, world, 1, steps)
    if any(not t.decision.valid or t.info.get("invalid") for t in one.transitions):
        raise RuntimeError(f"{world}: the answer is no valid action; the measurement would be of re-asking")
    many_cpu, many_wall, many = play(agent, world, 64, steps)
    taken = sum(len(t.transitions) for t in many)
    return {
        "overhead_ms_per_step": 1e3 * (cpu - alone(one)) / len(one.transitions),
        "steps_per_s_64": taken / many_cpu,
        "steps_per_s_64_wall": taken / many_wall,
    }


def main() -> None:
    """All scaffolds in all worlds; a table or JSON."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=40, help="steps of an episode")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = {w: {s: measure(spec, w, options.steps) for s, spec in SCAFFOLDS.items()} for w in WORLDS}
    headline = {k: found["deliverybench"]["react+base"][k] for k in ("overhead_ms_per_step", "steps_per_s_64")}
    if options.json:
        print(json.dumps(headline | {"worlds": found}))
        return
    for world, rows in found.items():
        for scaffold, r in rows.items():
            print(
                f"{world:<14} {scaffold:<22} {r['overhead_ms_per_step']:6.2f} ms/step overhead  "
                f"{r['steps_per_s_64']:7.0f} steps/s of a core at 64 ({r['steps_per_s_64_wall']:.0f} on the wall)"
            )


if __name__ == "__main__":
    main()
