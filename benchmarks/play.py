"""Can a strong model play through every method? `python -m benchmarks.play --json`.

In the model's seat sits one that plays well (it knows what the scripted courier would do) and writes like a chat model:
every answer in another of the forms of `benchmarks.formats`, reasoning blocks, JSON, tool calls and invented later
turns among them. It is asked through the free protocol of an endpoint, so menus do not constrain it either. What is
lost on the way from such an answer to the environment is the method's or the reader's fault: every method must complete
deliveries, with `invalid_share` 0, at the number of calls it declares.

The table: `{"method": {"deliveries", "invalid_share", "calls_per_step"}}`, methods in native and in menu mode.
"""

from __future__ import annotations

import argparse
import json
import random
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from agentspec.envs.experts import Player, player
from agentspec.envs.making import environment_id
from agentspec.episode import Job, Runner
from agentspec.llm.base import Message, Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.perception.generic import GenericPerception
from agentspec.spec import AgentSpec
from agentspec.types import AgentInput, LLMCall, Task
from benchmarks.formats import FORMATS

ENV = "deliverybench"
OPTIONS: dict[str, Any] = {"size": "small", "shift_hours": 1.0, "order_seed": 1}

SMALL_SEARCH = {"preset": "rl"}
REASONERS: dict[str, Any] = {
    "direct": "direct",
    "cot": "cot",
    "react": "react",
    "plan_and_solve": "plan_and_solve",
    "plan_and_solve, persistent": {"name": "plan_and_solve", "persistent": True},
    "self_consistency": "self_consistency",
    "mad": "mad",
    "tot": {"name": "tot", **SMALL_SEARCH},
    "tot, sample": {"name": "tot", **SMALL_SEARCH, "generation": "sample"},
    "rap": {"name": "rap", **SMALL_SEARCH},
    "lats": {"name": "lats", **SMALL_SEARCH, "num_iterations": 1, "n_generate_sample": 1, "root_samples": 2},
}
REFLECTORS = ("self_refine", "reflexion", "retroformer")


class Listening(GenericPerception):
    """The generic perception, which remembers what it showed last."""

    latest: AgentInput | None = None

    def perceive(self, task: Task, observation: Mapping[str, Any], info: Mapping[str, Any]) -> AgentInput:
        """u_t of one observation."""
        Listening.latest = super().perceive(task, observation, info)
        return Listening.latest


class ChatModel(ScriptedLLM):
    """A model that plays like the environment's expert and writes like a chat model, whatever it is bound to."""

    def __init__(self, task: Task) -> None:
        super().__init__(self._reply, score=self._likely, name="chat model")
        self._expert: Player = player(environment_id(task.env), "rule_based", task.options, random.Random(0))
        self._decided: dict[tuple[str, int], str] = {}
        self._action = ""
        self._written = 0

    async def generate(self, request: Request) -> LLMCall:
        """A free answer; a menu does not constrain it."""
        self._offered = request.sampling.choices
        return await super().generate(replace(request, sampling=replace(request.sampling, choices=())))

    def _reply(self, request: Request) -> str:
        purpose = request.tag.purpose
        if purpose in ("act", "propose", "refine"):
            return self._dress(self._choose(request))
        if purpose == "feedback":
            return "Verdict: change\nThink again." if request.id % 3 == 0 else "**Verdict:** keep"
        fixed = {
            "value": "That should work: 9. I am sure",
            "vote": "1",
            "judge": "good",
            "plan": "1. Take an order that pays\n2. Deliver it",
            "world": "It worked.\nEarned: 1\nGoal: no",
            "reflect": "Take orders that lie near each other.",
        }
        return fixed.get(purpose, "<think>The orders nearby pay best.</think>Go on with the order that pays.")

    def _choose(self, request: Request) -> str:
        """What the expert does at this step; asked once, from what was perceived at its beginning."""
        at = (request.tag.episode, request.tag.step)
        seen = Listening.latest
        if at not in self._decided and seen is not None:
            self._decided[at] = self._expert.act({"state": seen.state, "action_schema": seen.action_schema})
        self._action = self._decided[at]
        if self._offered and self._action not in self._offered:
            return self._offered[0]  # a state that a search imagined or tried
        return self._action

    def _dress(self, action: str) -> str:
        """The action in the next form."""
        decoy = next((c for c in self._offered if c != action), "WAIT(1)")
        form = list(FORMATS.values())[self._written % len(FORMATS)]
        self._written += 1
        return form(action, decoy)

    def _likely(self, messages: Sequence[Message], continuation: str) -> float:
        return 0.0 if continuation in ("good", self._action) else -20.0


def played(spec: Mapping[str, Any], *, menu: bool, max_steps: int, trials: int = 1, seed: int = 0) -> dict[str, float]:
    """Deliveries, share of invalid actions and calls per step of an agent with the chat model in its seat."""
    task = Task(ENV, seed, {**OPTIONS, "action_mode": "menu" if menu else "native"})
    agent = AgentSpec.from_data({**spec, "perception": "benchmarks.play:Listening"})
    state = None
    deliveries = steps = invalid = calls = 0
    for trial in range(trials):
        runner = Runner(agent, ChatModel(task), max_steps=max_steps)
        (trajectory,) = runner.run([Job(task, run_seed=trial, memory_state=state)])
        if trajectory.status != "completed":
            raise RuntimeError(f"{agent.label} failed: {trajectory.error}")
        state = trajectory.memory_state
        metrics = trajectory.metrics
        deliveries += metrics["deliveries"]
        steps += metrics["steps"]
        invalid += metrics["invalid_actions"]
        calls += metrics["llm_calls"]
    return {
        "deliveries": deliveries,
        "invalid_share": round(invalid / steps, 4),
        "calls_per_step": round(calls / steps, 2),
    }


def agents() -> dict[str, tuple[dict[str, Any], int]]:
    """Name in the table -> (spec, trials)."""
    found: dict[str, tuple[dict[str, Any], int]] = {}
    for name, reasoning in REASONERS.items():
        found[name] = ({"reasoning": reasoning, "memory": "base"}, 1)
    for name in REFLECTORS:
        learns = name != "self_refine"
        spec = {"reasoning": "react", "reflection": name, **({"scope": "run"} if learns else {})}
        found[f"react+{name}"] = (spec, 2 if learns else 1)
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Play and print the table."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--max-steps", type=int, default=120, help="most steps of an episode (120)")
    parser.add_argument("--only", nargs="*", default=[], metavar="METHOD", help="these methods only")
    arguments = parser.parse_args(argv)
    table: dict[str, dict[str, float]] = {}
    for name, (spec, trials) in agents().items():
        if arguments.only and name not in arguments.only:
            continue
        for menu in (False, True):
            label = f"{name} (menu)" if menu else name
            table[label] = played(spec, menu=menu, max_steps=arguments.max_steps, trials=trials)
            if not arguments.json:
                print(f"{label:40} {table[label]}", flush=True)
    if arguments.json:
        print(json.dumps(table, indent=2))
    lost = [name for name, row in table.items() if row["invalid_share"] or not row["deliveries"]]
    return 1 if lost else 0


if __name__ == "__main__":
    # The spec names `benchmarks.play:Listening`; run that module, not a second copy of it.
    from benchmarks.play import main as play

    raise SystemExit(play())
