"""Write the prompt gallery, `docs/prompts/`: `python docs/update_prompts.py`. A test holds that it is current.

One page per method, and one per memory (`memory_gallery`). A method's page shows the full prompt of an action at the
third step, for both layouts and for native and menu actions of each environment, and what else the method asks at such
a step. A scripted model answers; nothing of it is random, so a page changes only when a prompt does.
"""

from __future__ import annotations

import functools
import sys
from pathlib import Path
from typing import Any

from agentspec.episode import Job, Runner
from agentspec.llm.base import Message, Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import REGISTRY
from agentspec.spec import AgentSpec
from agentspec.state import write_atomic
from agentspec.tokens import estimate_tokens
from agentspec.types import Task

sys.path.insert(0, str(Path(__file__).parent))
import memory_gallery

FOLDER = Path(__file__).with_name("prompts")
STEP = 2
ENVIRONMENTS: dict[str, Task] = {
    "DeliveryBench, native actions": Task("deliverybench", 1, {"size": "small", "observation": "full"}),
    "DeliveryBench, menu": Task("deliverybench", 1, {"size": "small", "observation": "compact", "action_mode": "menu"}),
    "MiniGrid": Task("minigrid", 1),
}
LAYOUTS = ("conversation", "snapshot")
ANSWERS = {
    "plan": "1. Take an order nearby\n2. Pick it up\n3. Deliver it",
    "feedback": "Verdict: change\nA minute is long.",
    "value": "This looks likely: 6",
    "judge": "good",
    "world": "A minute has passed.\nEarned: 0\nGoal: no",
    "reflect": "Take an order before waiting.",
    "think": "The board should be read first.",
    "argue": "The board should be read first.",
    "curate": "- Seen until step {step}: orders near each other pay best.",
}
ANSWERS_IN_A_GRID = {
    "plan": "1. Find the box\n2. Go to it\n3. Say so",
    "feedback": "Verdict: change\nThat is a wall.",
    "world": "One cell further.\nEarned: 0\nGoal: no",
    "reflect": "Look around before walking.",
    "curate": "- Seen until step {step}: the box is not far.",
}
SHEET = {"name": "dynamic_cheatsheet", "every": 1, "tags": False}
"""A memory that rewrites what it recalls after every step: what `recall: kept` keeps in the turns before."""

ACTIONS = ("VIEW_ORDERS()", "WAIT(60)", "VIEW_ORDERS()")
IN_A_GRID = ("FORWARD()", "TURN_LEFT()", "FORWARD()")


class Scripted(ScriptedLLM):
    """Counts tokens as models do (about four signs each) and not by the byte, so budgets cut where they would."""

    def count_tokens(self, text: str) -> int:
        return estimate_tokens(text)


def methods() -> dict[str, dict[str, Any]]:
    """Page -> spec: every reasoner, and every reflector around `direct`."""
    pages: dict[str, dict[str, Any]] = {}
    for name, entry in REGISTRY.all("reasoning").items():
        if not entry.scripted and entry.target.startswith("agentspec."):
            preset = {"preset": "rl"} if name in ("tot", "rap", "lats") else {}
            pages[name] = {"reasoning": {"name": name, **preset}, "memory": "base"}
    pages["recall-kept"] = {"reasoning": "direct", "memory": SHEET, "recall": "kept"}
    pages["plan_and_solve-persistent"] = {"reasoning": {"name": "plan_and_solve", "persistent": True}, "memory": "base"}
    for name, entry in REGISTRY.all("reflection").items():
        if name != "none" and entry.target.startswith("agentspec."):
            scope = entry.declaration.scope or "episode"
            pages[name] = {"reasoning": "direct", "memory": "base", "reflection": name, "scope": scope}
    return pages


def answer(request: Request) -> str:
    """What the scripted model says."""
    if request.sampling.choices:
        return request.sampling.choices[min(request.tag.step, len(request.sampling.choices) - 1)]
    grid = "- TURN_LEFT()" in request.messages[0].text
    action = (IN_A_GRID if grid else ACTIONS)[request.tag.step % len(ACTIONS)]
    answers = {**ANSWERS, **(ANSWERS_IN_A_GRID if grid else {})}
    if request.tag.purpose == "curate":
        return answers["curate"].format(step=request.tag.step)
    return answers.get(request.tag.purpose, f"Thought: step {request.tag.step + 1} of the plan.\nAction: {action}")


def requests_of(spec: dict[str, Any], task: Task) -> list[Request]:
    """All requests of the last of as many trials as the method needs to show what it adds."""
    state = None
    requests: list[Request] = []
    for trial in range(2 if spec.get("scope") == "run" else 1):
        requests = []

        def script(request: Request, kept: list[Request] = requests) -> str:
            kept.append(request)
            return answer(request)

        runner = Runner(AgentSpec.from_data(spec), Scripted(script), max_steps=STEP + 1)
        (trajectory,) = runner.run([Job(task, run_seed=trial, memory_state=state)])
        state = trajectory.memory_state
    return requests


def page(name: str, spec: dict[str, Any]) -> str:
    """The page of a method."""
    memory = "`dynamic_cheatsheet` memory and `recall: kept`" if "recall" in spec else "`base` memory"
    parts = [
        f"# Prompts of `{name}`",
        "Generated by `python docs/update_prompts.py`. The prompts of one decision, at the third step of an episode "
        f"with {memory}; the answers in them are a scripted model's.",
    ]
    for environment, task in ENVIRONMENTS.items():
        for layout in LAYOUTS:
            parts.append(f"## {environment}, layout `{layout}`")
            parts += shown(requests_of({**spec, "layout": layout}, task))
    return "\n\n".join(parts) + "\n"


def shown(requests: list[Request]) -> list[str]:
    """The first prompt of the step in full, then the end of the others: one for each purpose."""
    step = sorted((r for r in requests if r.tag.step == STEP), key=lambda r: r.tag.module.partition(".")[0] == "memory")
    if not step:
        return ["(no request at this step)"]
    parts = [f"`{step[0].tag.path}`{_sampling(step[0])}", _fenced("\n\n".join(map(_turn, step[0].messages)))]
    seen = {step[0].tag.path}
    for request in [*step, *(r for r in requests if r.tag.step > STEP)]:
        if request.tag.path not in seen:
            seen.add(request.tag.path)
            parts += [f"`{request.tag.path}`{_sampling(request)} ends with", _fenced(_tail(request.messages[-1].text))]
    return parts


def _tail(text: str, paragraphs: int = 4) -> str:
    """The last paragraphs of a turn, at most 2,000 signs."""
    return "\n\n".join(text.split("\n\n")[-paragraphs:])[-2000:]


def _turn(message: Message) -> str:
    return f"--- {message.role} ---\n{message.text}"


def _sampling(request: Request) -> str:
    sampling = request.sampling
    bits = [f"{sampling.n} samples"] if sampling.n > 1 else []
    bits += [f"temperature {sampling.temperature:g}"] if sampling.temperature != 1 else []
    bits += (
        [f"one of {len(sampling.choices)} choices"] if sampling.choices else [f"at most {sampling.max_tokens} tokens"]
    )
    return f" ({', '.join(bits)})"


def _fenced(text: str) -> str:
    return f"````text\n{text}\n````"


@functools.cache
def gallery() -> dict[str, str]:
    """File name -> page."""
    pages = {f"{name}.md": page(name, spec) for name, spec in methods().items()} | memory_gallery.pages()
    index = "\n".join(f"- [`{name.removesuffix('.md')}`]({name})" for name in sorted(pages))
    order = (
        "What stands in a prompt, in this order: instruction, rules and actions of the environment; how to answer; "
        "then, in the newest user turn, lessons, memory, a method's transcript, the observation, and what is asked."
    )
    return {"README.md": f"# Prompt gallery\n\n{order}\n\n{index}\n", **pages}


def main() -> None:
    """Write the gallery; pages of methods that are gone are removed."""
    FOLDER.mkdir(exist_ok=True)
    pages = gallery()
    for path in FOLDER.glob("*.md"):
        if path.name not in pages:
            path.unlink()
    for name, text in pages.items():
        write_atomic(FOLDER / name, text)


if __name__ == "__main__":
    main()
