"""Buffer of Thoughts (Yang et al., 2024, arXiv 2406.04271): ways of working, distilled, looked up, and kept if new.

The buffer holds *thought templates*: a category, a description of the tasks it is for, and the way of working, with the
instance taken out. In every episode:

1. the problem distiller (one call) writes key facts, constraints and goal of the task from its first state;
2. the template whose description is most similar to that is looked up; if none reaches `threshold`, the task counts
   as new and the nearest of three coarse templates stands in;
3. the reasoner works by it: task and template stand in every prompt of the episode;
4. the buffer manager (one call) distils a template from what was done and what came of it, and keeps it only if it is
   new: its description is less than `keep_threshold` similar to all others (`novelty: similarity`, the paper's rule),
   or the model says so when it is shown the nearest (`novelty: llm`, the authors' code; one call more).

The paper has one threshold of 0.5 to 0.7 and a large embedder. MiniLM's similarities are lower where a task is held
against a description: 0.44 to 0.46 for delivery shifts among themselves, at most 0.08 for other kinds; two
descriptions of one kind are 0.52 to 0.57 similar, of two kinds at most 0.29. Hence the two defaults, 0.35 and 0.5.

AgentSpec's form: an episode is the paper's problem. Step 4 waits for the beginning of the run's next episode, so that
nothing is distilled that nobody reads, and the episode that reads it pays for it: the method learns only under
`scope: run`; within one episode it gives the distilled task and a coarse template. `distiller: none` asks no model, as
the AgentSpec site's `bot`: the first state stands for the task, and the course of action names for the way of working.
Failed answers: without a distilled task the first state is looked up, without a template nothing is kept. Presets:
`paper` and `rl` (shorter prompts, no repairs); both cost a call or two an episode. At most `max_size` templates; the
one used least, of equals the oldest, goes first.
"""

from __future__ import annotations

import itertools
from dataclasses import asdict, replace

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import system, user
from agentspec.memory.buffer_of_thought import prompts
from agentspec.memory.buffer_of_thought.templates import COARSE, Template
from agentspec.memory.parts import telling
from agentspec.memory.parts.steps import written
from agentspec.parameters import at_least, one_of, settings
from agentspec.protocols import Services
from agentspec.registry import SpecError
from agentspec.retrieval import VectorIndex
from agentspec.state import dump_state, keyed, load_state
from agentspec.structured import json_of
from agentspec.tokens import clip_text, excerpt
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Experience, Recall, RecallItem, Task, Transition

PRESETS = {
    "paper": {"state_tokens": 768, "task_tokens": 1024, "course_tokens": 2048, "answer_tokens": 512, "repairs": 1},
    "rl": {"state_tokens": 256, "task_tokens": 192, "course_tokens": 512, "answer_tokens": 192, "repairs": 0},
}
MOST_STEPS = 64
"""Newest steps of an episode that a template is distilled from."""
MOST_NEAREST = 3
"""Templates that a new one is held against by the model."""


class BufferOfThought:
    """Thought templates, distilled from episodes and looked up for new ones.

    Args:
        preset: `paper` or `rl`; see the module's docstring. The parameters that it sets are `None` here.
        distiller: `llm`, or `none`: no call at all.
        threshold: similarity to every template below which a task is new.
        keep_threshold: similarity to every other template below which a template is.
        novelty: who says whether a template is new: `similarity` or `llm`.
        max_size: most templates.
        template_tokens: most tokens of a template's steps.
        state_tokens: most tokens of the first state in the distiller's prompt.
        task_tokens: most tokens of the task's instruction there and in the buffer manager's.
        course_tokens: most tokens of an episode's steps in the buffer manager's prompt.
        answer_tokens: room for an answer.
        repairs: further calls for an answer that cannot be read (0 or 1).
    """

    declaration = Declaration(
        "thought templates distilled from episodes, looked up for tasks like them, kept if new",
        calls=CallProfile(retrieve=(0, 3)),
        rl=CallProfile(retrieve=(0, 2)),
        purposes={
            "distil": Purpose("retrieve", "Key facts: the number is 3.\nConstraints: few steps.\nGoal: the target."),
            "template": Purpose(
                "retrieve",
                '{"category": "arithmetic", "description": "Reach a target number by operations.", '
                '"template": "1. DOUBLE() while it stays below. 2. Correct it."}',
            ),
            "novel": Purpose("retrieve", '{"new": true}'),
        },
        needs=("embedder",),
        small=(
            {"novelty": "llm", "max_size": 1, "repairs": 0},
            {"distiller": "none", "max_size": 1, "keep_threshold": 1.0},
        ),
        aliases=("bot",),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        distiller: str = "llm",
        threshold: float = 0.35,
        keep_threshold: float = 0.5,
        novelty: str = "similarity",
        max_size: int = 200,
        template_tokens: int = 256,
        state_tokens: int | None = None,
        task_tokens: int | None = None,
        course_tokens: int | None = None,
        answer_tokens: int | None = None,
        repairs: int | None = None,
    ) -> None:
        given = {"state_tokens": state_tokens, "task_tokens": task_tokens, "course_tokens": course_tokens}
        given |= {"answer_tokens": answer_tokens, "repairs": repairs}
        chosen: dict[str, int] = settings("buffer_of_thought", PRESETS, preset, given)
        one_of(
            "buffer_of_thought",
            distiller=(distiller, ("llm", "none")),
            novelty=(novelty, ("similarity", "llm")),
        )
        positive = {name: value for name, value in chosen.items() if name != "repairs"}
        at_least("buffer_of_thought", 1, max_size=max_size, template_tokens=template_tokens, **positive)
        if not (0 <= threshold <= 1 and 0 <= keep_threshold <= 1) or chosen["repairs"] not in (0, 1):
            raise SpecError(
                f"buffer_of_thought: threshold={threshold} and keep_threshold={keep_threshold} must lie in 0..1, and "
                f"repairs={chosen['repairs']} be 0 or 1"
            )
        self.services = services
        self.asks, self.novelty = distiller == "llm", novelty
        self.threshold, self.keep_threshold = threshold, keep_threshold
        self.max_size, self.template_tokens = max_size, template_tokens
        self.state_tokens, self.task_tokens = chosen["state_tokens"], chosen["task_tokens"]
        self.course_tokens, self.answer_tokens = chosen["course_tokens"], chosen["answer_tokens"]
        self.repairs = chosen["repairs"]
        self._index = VectorIndex(services.embedder) if services.embedder else None
        self._coarse = VectorIndex(services.embedder) if services.embedder else None
        for number, template in enumerate(COARSE):
            if self._coarse is not None:
                self._coarse.put(number, template.description)
        self._buffer: dict[int, Template] = {}
        self._problem, self._working = "", ""  # what stands in every prompt of the episode
        self._looked_up = ""  # what the template was looked up by
        self._started = False
        self._done = ""  # the instruction that the newest step followed
        self._course: list[list[str]] = []
        self._finished: list[list[str]] = []  # the course of the episode before, until a template is distilled from it
        self._figures = {"templates": 0, "kept": 0, "known": 0, "coarse": 0}

    @property
    def templates(self) -> tuple[Template, ...]:
        """The buffer, oldest first."""
        return tuple(self._buffer.values())

    def begin_episode(self, task: Task) -> None:
        self._started, self._course = False, []

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """The distilled task and the way of working, both chosen before the first action (`k` changes nothing)."""
        if not self._started:
            self._started = True
            await self._manage()
            await self._begin(input)
        source = self.services.llm.module
        items = []
        if self._problem:
            items.append(
                RecallItem(prompts.TASK.format(problem=self._problem), kind="summary", source=source, priority=1)
            )
        if self._working:
            items.append(RecallItem(self._working, kind="procedural", source=source, priority=2))
        return Recall(tuple(items))

    async def store(self, transition: Transition) -> None:
        seen = Experience.of(transition)
        self._done = transition.input.instruction
        state = excerpt(seen.state, self.state_tokens, self._count)
        self._course = [*self._course, [state, seen.line()]][-MOST_STEPS:]

    async def end_episode(self, trajectory: Trajectory) -> None:
        """Keep the course; the template is distilled when the next episode of the run begins."""
        if self._course:
            ended = telling.outcome(trajectory)
            self._finished = [["", self._looked_up], *self._course, ["", ended]]
            self._course = []

    # -- before an episode -----------------------------------------------------------------------------------------

    async def _begin(self, input: AgentInput) -> None:
        """Distil the task, and look up a way of working for it."""
        state = excerpt(input.text, self.state_tokens, self._count)
        self._problem, self._looked_up = "", state
        if self.asks:
            prompt = (
                system(prompts.DISTIL.format(task=self._task(input.instruction))),
                user(prompts.STATE.format(state=state, words=self.answer_tokens // 2)),
            )
            answer = await self.services.ask("distil", prompt, self.answer_tokens)
            self._problem = written(answer, self.answer_tokens, self._count)
            self._looked_up = self._problem or state
        self._working = self._template_for(self._looked_up)

    def _template_for(self, problem: str) -> str:
        """The nearest template if it is near enough, else the nearest coarse one."""
        if self._index is None or self._coarse is None:
            return ""
        nearest = self._index.search(problem, 1, least=self.threshold)
        if nearest:
            key = nearest[0][0]
            found = self._buffer[key] = replace(self._buffer[key], uses=self._buffer[key].uses + 1)
        else:
            self._figures["coarse"] += 1
            found = COARSE[self._coarse.search(problem, 1)[0][0]]
        return prompts.SHOWN.format(**asdict(found))

    # -- after an episode ------------------------------------------------------------------------------------------

    async def _manage(self) -> None:
        """Distil a template from the episode before, and keep it if it is new."""
        if not self._finished or self._index is None:
            return
        finished, self._finished = self._finished, []
        template = await self._distilled(finished) if self.asks else self._without_model(finished)
        if template is None:
            return
        self._figures["templates"] += 1
        if await self._is_new(template):
            self._keep(template)
        else:
            self._figures["known"] += 1

    async def _distilled(self, finished: list[list[str]]) -> Template | None:
        course = telling.course(finished[1:], self.course_tokens, self._count)
        prompt = (
            system(prompts.TEMPLATE.format(task=self._task(self._done))),
            user(
                prompts.EPISODE.format(
                    problem=finished[0][1], steps=telling.STEPS, course=course, words=self.answer_tokens // 2
                )
            ),
        )
        parse = json_of({"category": str, "description": str, "template": str}, repairs=self.repairs)
        answer = await self.services.ask("template", prompt, self.answer_tokens, parse)
        if answer.value is None:
            return None
        category, description = (" ".join(answer.value[name].split()) for name in ("category", "description"))
        steps = clip_text(answer.value["template"].strip(), self.template_tokens, self._count)
        if not description or not steps:
            self.services.count("malformed")
            return None
        limit = self.template_tokens // 4
        return Template(clip_text(category, limit, self._count), clip_text(description, limit, self._count), steps)

    def _without_model(self, finished: list[list[str]]) -> Template:
        """The first state as the description, and the names of the actions in order as the way of working."""
        names = [line.partition(". ")[2].partition("(")[0] for _, line in finished[1:-1]]
        runs = [(name, len(list(run))) for name, run in itertools.groupby(names)]
        course = ", ".join(name if n == 1 else f"{name} x{n}" for name, n in runs)
        steps = clip_text(f"{finished[-1][1]} {course}", self.template_tokens, self._count)
        return Template("as it was done before", finished[0][1], steps)

    async def _is_new(self, template: Template) -> bool:
        assert self._index is not None
        if self.novelty == "similarity" or not self.asks:
            nearest = self._index.search(template.description, 1)
            return not nearest or nearest[0][1] < self.keep_threshold
        near = [self._buffer[key] for key, _ in self._index.search(template.description, MOST_NEAREST)]
        shown = "\n\n".join(other.text() for other in near or COARSE)
        prompt = prompts.NOVEL.format(nearest=shown, new=template.text())
        answer = await self.services.ask("novel", prompt, 64, json_of({"new": bool}, repairs=self.repairs))
        return answer.value is not None and bool(answer.value["new"])

    def _keep(self, template: Template) -> None:
        assert self._index is not None
        while len(self._buffer) >= self.max_size:
            least = min(self._buffer, key=lambda key: (self._buffer[key].uses, key))
            del self._buffer[least]
            self._index.remove(least)
        key = self.services.new_id()
        self._buffer[key] = template
        self._index.put(key, template.description)
        self._figures["kept"] += 1

    def _task(self, instruction: str) -> str:
        return clip_text(instruction.strip(), self.task_tokens, self._count) or "(not told)"

    def _count(self, text: str) -> int:
        return self.services.llm.count_tokens(text)

    # -- state -----------------------------------------------------------------------------------------------------

    def metrics(self) -> dict[str, int]:
        """Templates in the buffer; distilled, kept and known ones so far; episodes with a coarse one."""
        return {"size": len(self._buffer), **self._figures}

    def snapshot(self) -> bytes:
        episode = [self._problem, self._working, self._looked_up, self._started, self._done]
        return dump_state([keyed(self._buffer), episode, self._course, self._finished, self._figures])

    def restore(self, blob: bytes) -> None:
        buffer, episode, self._course, self._finished, self._figures = load_state(blob)
        self._problem, self._working, self._looked_up, self._started, self._done = episode
        self._buffer = {key: Template(*row) for key, row in buffer}
        if self._index is not None:
            self._index.load([(key, template.description) for key, template in self._buffer.items()])
