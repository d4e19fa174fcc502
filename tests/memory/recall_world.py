"""A world in which one fact, seen long ago, decides: is it recalled?

At step 0 a notice shows a fact (a code, a colour, a place). Distracting steps follow, each with something else to see.
Then the question is asked, and only the right `ANSWER` earns anything. With `part: show` an episode ends before the
question; with `part: ask` an episode of the same seed holds the question alone: the fact can then only come from the
episode before (`scope: run`).

`Reader` is a scripted model that knows nothing: it answers the question right exactly if the fact stands in its prompt,
and answers what a memory asks (`memory.*`) with the declared example of the purpose, its sentences replaced by those of
the world that stand in that very prompt. What a memory did not show to the model, the model cannot have kept.

    assert not succeeds({"name": "base", "window": 5})
    assert succeeds({"name": "my_memory"}) and succeeds({"name": "my_memory"}, scope="run")
"""

from __future__ import annotations

import json
import random
import re
import string
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium
from gymnasium import spaces

from agentspec.actions import parse_action
from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.metrics import Metric
from agentspec.registry import REGISTRY
from agentspec.spec import AgentSpec
from agentspec.state import dump_state, load_state
from agentspec.tokens import estimate_tokens
from agentspec.trajectory import Trajectory
from agentspec.types import ActionError, ActionSchema, ActionSpec, LLMCall, Parameter, Task

FACTS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "code": ("The code of the vault is {}.", "What is the code of the vault?", ("K7Q2", "M3X9", "T8B5", "R4W6")),
    "colour": ("The colour of the flag is {}.", "What colour is the flag?", ("teal", "ochre", "crimson", "mauve")),
    "place": ("The parcel is kept at {}.", "Where is the parcel kept?", ("Harbour", "Mill", "Chapel", "Quarry")),
}
"""Kind of fact -> how it is told, how it is asked for, and what it may be."""

NOTICE = "A notice reads: {}"
QUESTION = "The guard asks: {} Answer it now."
SIGHTS = (
    "A cart with {n} barrels rolls past.",
    "{n} pigeons sit on the roof of the bakery.",
    "A baker sells loaves for {n} coins.",
    "{n} children play at the fountain.",
    "A clock strikes {n}.",
    "A cobbler mends {n} boots.",
)
SIGHT = re.compile("|".join(re.escape(s).replace(r"\{n\}", r"\d+") for s in SIGHTS))

ACTIONS = {
    "WALK": ActionSpec("WALK", "walk on", example="WALK()"),
    "ANSWER": ActionSpec("ANSWER", "answer the guard", {"answer": Parameter("str")}, example='ANSWER("...")'),
}


class RecallEnv(gymnasium.Env[dict[str, Any], str]):
    """A walk with a notice at its beginning and a question at its end.

    Args:
        delay: steps between notice and question (in an episode without the one, steps before the other).
        part: `both`, `show` (the episode ends before the question) or `ask` (it begins after the notice).
    """

    observation_space = spaces.Dict({"text": spaces.Text(300, charset=string.printable)})
    action_space = spaces.Text(100)
    metadata = {  # noqa: RUF012
        "render_modes": [],
        "metrics": (Metric("success"),),
        "typical_return": 1.0,
    }

    def __init__(self, delay: int = 20, part: str = "both") -> None:
        if part not in ("both", "show", "ask"):
            raise ValueError(f"part must be both, show or ask, got {part!r}")
        self.delay, self.part = delay, part
        self.t, self.success, self.kind, self.fact = 0, False, "", ""
        self.sights: list[str] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.kind, self.fact = fact_of(seed or 0)
        rng = random.Random(f"{seed} {self.part}")
        self.sights = [rng.choice(SIGHTS).format(n=rng.randint(2, 60)) for _ in range(self.delay + 1)]
        self.t, self.success = 0, False
        return self._observation(), self._info()

    @property
    def last(self) -> int:
        """Number of the last step."""
        return self.delay if self.part != "show" else self.delay - 1

    def step(self, action: str) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.t > self.last:
            return self._observation(), 0.0, True, False, self._info()
        parsed = parse_action(action, ActionSchema(ACTIONS))
        error = parsed.message if isinstance(parsed, ActionError) else ""
        asked = self.t == self.delay and self.part != "show"
        if asked and not isinstance(parsed, ActionError) and parsed.name == "ANSWER":
            said = str((*parsed.args, *parsed.kwargs.values(), "")[0])
            self.success = said.strip().casefold() == self.fact.casefold()
        self.t += 1
        reward = float(self.success and asked)
        return self._observation(), reward, self.t > self.last, False, self._info(error)

    def snapshot(self) -> bytes:
        return dump_state([self.t, self.success, self.kind, self.fact, self.sights])

    def restore(self, blob: bytes) -> None:
        self.t, self.success, self.kind, self.fact, self.sights = load_state(blob)

    def _observation(self) -> dict[str, Any]:
        if self.t > self.last:
            return {"text": "The walk is over."}
        text = self.sights[self.t]
        told, question, _ = FACTS[self.kind]
        if self.t == 0 and self.part != "ask":
            text = f"{NOTICE.format(told.format(self.fact))} {text}"
        elif self.t == self.delay and self.part != "show":
            text = QUESTION.format(question)
        return {"text": text}

    def _info(self, error: str = "") -> dict[str, Any]:
        return {
            "instruction": "You walk through a town. Somebody may ask you about what you have seen.",
            "action_schema": ActionSchema(ACTIONS),
            "state": {"t": self.t},
            "error": error,
            "message": "" if error or not self.t else "you walk on",
            "invalid": bool(error),
            "success": self.success,
            "metrics": {"success": float(self.success)},
        }


RECALL = "agentspec-test/Recall-v0"
if RECALL not in gymnasium.registry:
    gymnasium.register(RECALL, entry_point="tests.memory.recall_world:RecallEnv")


def fact_of(seed: int) -> tuple[str, str]:
    """Kind and value of the fact of a seed; three seeds in a row are of three kinds."""
    kind = list(FACTS)[seed % len(FACTS)]
    return kind, random.Random(seed).choice(FACTS[kind][2])


Curate = Callable[[Request], str]


class Reader(ScriptedLLM):
    """A model that knows what stands in its prompt and nothing else.

    Args:
        curate: purpose of a memory's call -> how to answer it, where the declared example with the prompt's sentences
            put in will not do (`notes(request)` gives these sentences). A text is an answer as it is.
        window: tokens of the context window; tokens are counted as four characters each.
    """

    def __init__(self, curate: Mapping[str, Curate | str] | None = None, window: int = 100_000) -> None:
        super().__init__(self._answer, name="reader", max_context=window)
        self.curate = dict(curate or {})
        self.asked: list[Request] = []

    async def generate(self, request: Request) -> LLMCall:
        room = replace(request.sampling, max_tokens=request.sampling.max_tokens * 4)  # its tokens are bytes
        call = await super().generate(replace(request, sampling=room))
        return replace(call, sampling=request.sampling)

    def count_tokens(self, text: str) -> int:
        return estimate_tokens(text)

    def _answer(self, request: Request) -> str:
        self.asked.append(request)
        if not request.tag.module.startswith("memory."):
            return act(request)
        how = self.curate.get(request.tag.purpose)
        if how is not None:
            return how if isinstance(how, str) else how(request)
        return curated(request)


def act(request: Request) -> str:
    """Walk on; at the question answer with the fact if the prompt shows it."""
    if "The guard asks:" not in request.messages[-1].text:
        return "WALK()"
    kind = next(k for k, (_, question, _) in FACTS.items() if question in request.messages[-1].text)
    shown = "\n".join(m.text for m in request.messages)
    found = max(FACTS[kind][2], key=lambda value: shown.rfind(value))
    return f'ANSWER("{found if found in shown else "I do not know"}")'


def notes(request: Request, *, most: int = 4) -> list[str]:
    """Sentences of the world that the prompt shows: the fact first, then the newest sights."""
    text = "\n".join(m.text for m in request.messages)
    facts = [told.format(value) for told, _, values in FACTS.values() for value in values]
    seen = [match.group() for match in SIGHT.finditer(text)]
    found = [f for f in facts if f in text] or [f"{v} was seen" for _, _, vs in FACTS.values() for v in vs if v in text]
    return list(dict.fromkeys([*found, *reversed(seen)]))[:most] or ["Nothing worth a note."]


def curated(request: Request) -> str:
    """The purpose's declared example with the prompt's sentences in place of its own.

    Texts of several words are sentences and are replaced; single words (operations, names, ids) stay as they are.
    """
    kind, _, name = request.tag.module.partition(".")
    example = REGISTRY.get(kind, name).purposes[request.tag.purpose].example
    found = notes(request)
    try:
        data = json.loads(example)
    except ValueError:
        return " ".join(found)
    used = iter(range(1_000_000))

    def filled(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: filled(v) for key, v in value.items()}
        if isinstance(value, list):
            return [filled(v) for v in value]
        if isinstance(value, str) and " " in value.strip():
            i = next(used)
            return " ".join(found) if i == 0 else found[i % len(found)]
        return value

    return json.dumps(filled(data))


def walk(
    memory: Any,
    *,
    scope: str = "episode",
    delay: int = 20,
    seed: int = 0,
    layout: str = "snapshot",
    curate: Mapping[str, Curate | str] | None = None,
    between: Sequence[int] = (),
    **spec: Any,
) -> tuple[list[Trajectory], Reader]:
    """The episodes that decide whether `memory` recalls the fact, the one with the question last.

    Args:
        memory: the `memory:` of a spec, a name or a mapping.
        scope: `episode`: notice and question stand in one episode; `run`: in two, the memory carried from one to the
            other.
        delay: steps between notice and question; of each of the episodes under `scope: run`.
        seed: which fact.
        layout: of the prompts; a `conversation` is cut to two turns, so that it does not hold the fact itself.
        curate: see `Reader`.
        between: seeds of episodes that show other facts, played between the two.
        spec: other fields of the agent's spec.
    """
    data = {
        "memory": memory,
        "reasoning": "direct",
        "layout": layout,
        "scope": scope,
        "max_turns": 2 if layout == "conversation" else 0,
        "embedder": "hash",
        **spec,
    }
    reader = Reader(curate)
    runner = Runner(AgentSpec.from_data(data), reader)
    if scope == "episode":
        return runner.run([Job(Task(RECALL, seed, {"delay": delay}))]), reader
    played: list[Trajectory] = []
    state: bytes | None = None
    for part, number in (("show", seed), *(("show", other) for other in between), ("ask", seed)):
        job = Job(Task(RECALL, number, {"delay": delay, "part": part}), memory_state=state)
        [trajectory] = runner.run([job])
        assert trajectory.status == "completed", trajectory.error
        state = trajectory.memory_state
        played.append(trajectory)
    return played, reader


def succeeds(memory: Any, *, seeds: Sequence[int] = (0, 1, 2), **how: Any) -> bool:
    """Whether the question is answered for every one of `seeds` (a code, a colour, a place); `how`: see `walk`."""
    ends = [walk(memory, seed=seed, **how)[0][-1] for seed in seeds]
    for end in ends:
        assert end.status == "completed", end.error
    return all(bool(end.metrics["success"]) for end in ends)
