"""Pages of the prompt gallery for memories: what each shows in a prompt, and what it asks.

The environment's own expert delivers orders for two episodes of a run (and tries one thing that fails, so that there is
a failure to remember); every memory sees the same steps, under preset `rl` where it has presets. What it asks is
answered by `ANSWERS`, which are written by hand from those steps. A page shows the memory's part of the last prompt of
the second episode, and the last question of each purpose.
"""

from __future__ import annotations

import functools
import json
import random
from dataclasses import replace
from typing import Any

from agentspec.envs.experts import player
from agentspec.envs.making import environment_id, make_env
from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import REGISTRY
from agentspec.spec import AgentSpec
from agentspec.tokens import estimate_tokens
from agentspec.types import LLMCall, Task

TASK = Task("deliverybench", 1, {"size": "small", "shift_hours": 1.0, "observation": "compact", "order_seed": 1})
STEPS, FAILING = 14, 5
QUESTION_SIGNS = 6000

FACT = "Restaurant 1 at (139.6m, 24.0m) had the food of order 3 ready 5 min after it was accepted."
RULE = "Accept two or three orders whose restaurants lie on one way before you walk."
FAILED = "PICKUP fails away from the restaurant: MOVE to it first, within 5m."
NOTE = "Order 3 was picked up at restaurant 1 at (139.6m, 24.0m) and is in bag compartment A."
SUMMARY = "Three orders were accepted; order 3 is in bag compartment A, its customer is 250m away."

ANSWERS: dict[str, Any] = {
    "ace/reflect": {"correct": RULE, "insight": FAILED, "bullets": []},
    "ace/curate": {
        "operations": [
            {"type": "ADD", "section": "STRATEGIES", "content": RULE},
            {"type": "ADD", "section": "MISTAKES", "content": FAILED},
        ]
    },
    "amem/analyse": {"keywords": ["order 3", "restaurant 1"], "context": NOTE, "tags": ["pickup", "bag"]},
    "amem/evolve": {"evolve": True, "links": ["n0"], "tags": ["pickup"], "neighbours": []},
    "buffer_of_thought/distil": "Key facts: restaurants within 400m.\nConstraints: one hour, hot food.\nGoal: earn.",
    "buffer_of_thought/template": {
        "category": "deliveries against the clock",
        "description": "Earn as much as possible by delivering orders within a short shift.",
        "template": "1. Read the board. 2. Accept orders on one way. 3. Pick up, bag, drop off. 4. Repeat.",
    },
    "cam/summarise": SUMMARY,
    "dynamic_cheatsheet/curate": f"<cheatsheet>\n- {RULE} (used 2 times)\n- {FAILED} (used 1 time)\n</cheatsheet>",
    "generative/rate": {"ratings": [3, 5, 8, 4, 6, 7, 2, 5]},
    "generative/question": {"questions": ["Which orders pay best per minute?"]},
    "generative/conclude": {"insights": [{"text": RULE, "evidence": [1, 2], "importance": 7}]},
    "gmemory/steps": "1. VIEW_ORDERS() 2. ACCEPT_ORDER of near ones 3. MOVE, PICKUP, PLACE_FOOD_IN_BAG 4. DROP_OFF.",
    "gmemory/mistake": FAILED,
    "gmemory/compare": {"operations": [{"op": "ADD", "rule": None, "text": RULE}]},
    "langmem/semantic": {"edits": [{"op": "insert", "id": None, "text": FACT}]},
    "langmem/episodic": {
        "observation": "Three orders on the board, all within 400m.",
        "thoughts": "Their restaurants lie on one way.",
        "action": "ACCEPT_ORDER, MOVE, PICKUP",
        "result": "All were picked up within 12 min; one PICKUP away from the restaurant failed.",
    },
    "langmem/procedural": RULE,
    "lightmem/extract": {"facts": [{"source": 0, "fact": FACT}, {"source": 1, "fact": FAILED}]},
    "lightmem/sleep": {"action": "ignore", "text": ""},
    "mem0/extract": {"facts": [FACT, FAILED]},
    "mem0/update": {"operations": [{"op": "UPDATE", "id": 0, "text": FACT}, {"op": "ADD", "id": None, "text": NOTE}]},
    "memgpt/edit": {
        "calls": [
            {"function": "core_append", "block": "task", "text": NOTE},
            {"function": "core_append", "block": "strategy", "text": RULE},
            {"function": "recall_search", "query": "failed PICKUP"},
        ]
    },
    "memgpt/summary": SUMMARY,
    "memorybank/summary": SUMMARY,
    "memorybank/insight": {"insights": [FACT], "avoid": [FAILED], "next": ["MOVE to the customer", "DROP_OFF"]},
    "mirix/edit_all": {
        "edits": [
            {"store": "episodic", "op": "insert", "fields": {"event": NOTE}},
            {"store": "procedural", "op": "insert", "fields": {"goal": "earn more per minute", "steps": RULE}},
        ]
    },
    "openclaw/learn": {
        "edits": [
            {"op": "add", "name": "one way", "text": RULE},
            {"op": "skill", "name": "pick up", "text": "1. MOVE 2. PICKUP 3. PLACE_FOOD_IN_BAG", "description": FAILED},
        ]
    },
    "openclaw/dream": {"rules": [{"name": "one way", "text": RULE}]},
    "simplemem/compress": {
        "notes": [
            {"text": FACT, "keywords": ["ready"], "place": "restaurant 1", "entities": ["order 3"], "topic": "food"},
            {"text": FAILED, "keywords": ["PICKUP"], "place": "", "entities": [], "topic": "errors"},
        ]
    },
    "simplemem/merge": {"text": FACT, "keywords": ["ready"]},
    "summary/summary": SUMMARY,
    "zep/extract": {
        "facts": [
            {"subject": "order 3", "relation": "is in", "object": "compartment A", "fact": NOTE, "since": None},
            {"subject": "restaurant 1", "relation": "serves", "object": "order 3", "fact": FACT, "since": None},
        ]
    },
    "zep/same": {"same": []},
    "zep/resolve": {"results": []},
    "zep/community": SUMMARY,
}


@functools.cache
def actions() -> tuple[str, ...]:
    """What the expert does in the task's first steps, with one action that fails."""
    expert = player(environment_id(TASK.env), "rule_based", TASK.options, random.Random(0))
    env = make_env(TASK)
    _, info = env.reset(seed=TASK.seed)
    chosen: list[str] = []
    for step in range(STEPS):
        chosen.append("PICKUP(orders=[99])" if step == FAILING else expert.act(info))
        *_, info = env.step(chosen[-1])
    env.close()
    return tuple(chosen)


def answer(request: Request) -> str:
    """The expert's action, or the answer to a memory's question."""
    kind, _, name = request.tag.module.partition(".")
    if kind == "reasoning":
        return actions()[request.tag.step]
    given = ANSWERS.get(f"{name}/{request.tag.purpose}", "")
    return given if isinstance(given, str) else json.dumps(given)


class Model(ScriptedLLM):
    """Keeps what it is asked; counts tokens as models do (about four signs each), so budgets cut where they would."""

    def __init__(self) -> None:
        super().__init__(answer)
        self.kept: list[Request] = []

    async def generate(self, request: Request) -> LLMCall:
        """The answer, which is a byte a token here: room for it is four times what was asked for."""
        self.kept.append(request)
        room = replace(request.sampling, max_tokens=4 * request.sampling.max_tokens)
        return await super().generate(replace(request, sampling=room))

    def count_tokens(self, text: str) -> int:
        """About four signs each."""
        return estimate_tokens(text)


def asked(name: str) -> tuple[list[Request], str]:
    """All requests of the second episode of a run with this memory, and the last observation."""
    entry = REGISTRY.get("memory", name)
    memory = {"name": name, **({"preset": "rl"} if entry.presets else {})}
    scope = entry.declaration.scope or "run"
    spec = AgentSpec.from_data(
        {"reasoning": "direct", "memory": memory, "layout": "snapshot", "scope": scope, "embedder": "hash"}
    )
    state, requests, seen = None, list[Request](), ""
    for trial in range(2):
        model = Model()
        (played,) = Runner(spec, model, max_steps=STEPS).run([Job(TASK, run_seed=trial, memory_state=state)])
        if played.status == "failed":
            raise RuntimeError(f"{name}: {played.error}")
        state, requests, seen = played.memory_state, model.kept, played.transitions[-1].input.text
    return requests, seen


def page(name: str) -> str:
    """The page of a memory."""
    requests, seen = asked(name)
    acting = [r for r in requests if r.tag.module.startswith("reasoning.")][-1]
    shown = acting.messages[-1].text.partition(seen)[0].strip() or "(nothing)"
    preset = ", preset `rl`" if REGISTRY.get("memory", name).presets else ""
    parts = [
        f"# What `{name}` shows and asks",
        f"Generated by `python docs/update_prompts.py`: DeliveryBench, layout `snapshot`{preset}, step {STEPS} of the "
        "second episode of a run; the expert of the environment acts, answers of memory are written by hand.",
        f"## Shown ({estimate_tokens(shown)} tokens)",
        f"````text\n{shown}\n````",
    ]
    last = {r.tag.path: r for r in requests if r.tag.module.startswith("memory.")}
    for path, request in last.items():
        text = "\n\n".join(f"--- {m.role} ---\n{m.text}" for m in request.messages)
        cut = "\n\n(cut here)" if len(text) > QUESTION_SIGNS else ""
        parts.append(f"## Asked: `{path}`, step {request.tag.step + 1}, at most {request.sampling.max_tokens} tokens")
        parts.append(f"````text\n{text[:QUESTION_SIGNS]}{cut}\n````")
    return "\n\n".join(parts) + "\n"


def pages() -> dict[str, str]:
    """File name -> page, of every memory."""
    ours = {n: e for n, e in REGISTRY.all("memory").items() if n != "none" and e.target.startswith("agentspec.")}
    names = [n for n, e in ours.items() if not e.declaration.extra]  # libraries ask and show what they like
    return {f"memory-{name}.md": page(name) for name in names}
