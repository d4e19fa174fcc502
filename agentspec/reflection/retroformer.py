"""Retroformer (Yao et al., 2024): a reflector that is a policy of its own, trained on what its reflections are worth.

It acts like Reflexion: a retrospective model reads a failed trial, its return and the earlier lessons, and writes a
lesson that stands in the actor's prompts. What makes it Retroformer is the training: the actor is frozen, and a lesson
is paid the change of return it brought, `G(next trial) - G(this trial)`.

*As it comes the reflector is untrained*: it is the policy's own weights, and the module measures what training needs.
The call that writes a lesson is tagged `reflection.retroformer/reflect` and credited as executed; its reward is known
one trial later and is recorded in *that* trial's metrics (`reflection/reward`, and by `reflection/episode` and
`reflection/call` whom it pays).

`when` says in which of the two trials the lesson is written: at the `end` of the failed one, or at the `start` of
the next. What the reflector reads is the same. With `start` a lesson and the trial that pays it are one episode, so
that many lessons can be drawn from the memory that one failed trial left: a trainer may learn from these.

The reflector reads the actions on offer, the fullest view of the trial (the pool of orders, say), and the thought
behind each step. `control` puts a fixed text in the place of every lesson: a meaningless one is what a trained
reflector is to be compared with, since any text in the prompt changes what an actor does. Cost: one call per failed
episode.
"""

from __future__ import annotations

import contextlib
from dataclasses import asdict, dataclass
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import ContextOverflowError, system, user
from agentspec.llm.recorder import BudgetExceededError
from agentspec.parameters import one_of
from agentspec.protocols import Services
from agentspec.reflection.reflexion import Reflexion
from agentspec.reflection.trials import TrialLog, episode_return
from agentspec.state import dump_state, load_state
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, LLMCall, Recall, Task
from agentspec.visible import visible

PATH = "reflection.retroformer/reflect"
WHEN = ("end", "start")


@dataclass(frozen=True)
class Due:
    """A lesson to be written: about which trial, its return, and what the reflector reads (two turns)."""

    trial: int
    before: float
    instruction: str
    request: str


@dataclass(frozen=True)
class Pending:
    """A lesson whose worth is not known yet: which call of which trial wrote it (-1: none, it is the `control`), and
    that trial's return."""

    episode: str
    trial: int
    call: int
    before: float


class Retroformer(Reflexion):
    """Lessons from failed trials, and the bookkeeping of what each was worth.

    Args:
        max_prompt_updates: lessons shown to the actor, the newest ones.
        threshold, max_repeats, key, reflection_tokens, trial_tokens, control: as in
            `agentspec.reflection.reflexion.Reflexion`.
        when: whether a lesson is written at the `end` of the failed trial or at the `start` of the next one.
        temperature: sampling temperature of lessons (`None`: the agent's).
    """

    declaration = Declaration(
        "Reflexion with a reflector of its own to be trained on the change of return (untrained as it comes)",
        calls=CallProfile(episode=(0, 1)),
        scope="run",
        purposes={"reflect": Purpose("episode")},
        small=({"when": "start"},),
        small_calls=CallProfile(retrieve=(0, 1)),
    )

    name = "retroformer"

    def __init__(
        self,
        services: Services,
        max_prompt_updates: int = 3,
        threshold: float | None = None,
        max_repeats: int = 0,
        key: str = "task",
        reflection_tokens: int = 256,
        trial_tokens: int = 1024,
        control: str = "",
        when: str = "end",
        temperature: float | None = None,
    ) -> None:
        super().__init__(
            services, max_prompt_updates, threshold, max_repeats, key, reflection_tokens, trial_tokens, control
        )
        one_of(self.name, when=(when, WHEN))
        self.when = when
        self.temperature = temperature
        self._due: dict[str, Due] = {}
        self._pending: dict[str, Pending] = {}
        self._measured: dict[str, Any] = {}

    def begin_episode(self, task: Task) -> None:
        super().begin_episode(task)
        self._measured = {}

    async def lessons(self, input: AgentInput) -> Recall:
        """As Reflexion's; writes the lesson that is due first."""
        due = self._due.pop(self._key, None)
        if due is not None:
            # Without room for a lesson the trial is played without one.
            with contextlib.suppress(BudgetExceededError, ContextOverflowError):
                await self._write(self._logs[self._key], due)
        return await super().lessons(input)

    async def end_episode(self, trajectory: Trajectory) -> None:
        """Pay the lesson of the trial before, then learn from this one if it failed."""
        total = episode_return(trajectory)
        paid = self._pending.pop(self._key, None)
        if paid is not None:
            self._measured = {
                "episode": paid.episode,
                "trial": paid.trial,
                "call": paid.call,
                "return_before": paid.before,
                "return_after": total,
                "reward": total - paid.before,
            }
        await self.reflect(trajectory)

    async def _ask(self, trajectory: Trajectory, log: TrialLog) -> LLMCall | None:
        due = Due(log.trials, episode_return(trajectory), *(m.text for m in self._prompt(trajectory, log)))
        if self.when == "start":
            self._due[self._key] = due
            return None
        return await self._write(log, due)

    async def _write(self, log: TrialLog, due: Due) -> LLMCall | None:
        """Ask for the lesson. An empty answer is no lesson, but a choice that is paid like any other.

        A `control` takes its place at the same time and is paid the same way, so that trials compare like with like.
        """
        if self.control:
            self._pending[self._key] = Pending("", due.trial, -1, due.before)
            self._learn(log, due.trial, self.control)
            return None
        sampling = {} if self.temperature is None else {"temperature": self.temperature}
        messages = (system(due.instruction), user(due.request))
        call = await self.services.llm.generate("reflect", messages, max_tokens=self.reflection_tokens, **sampling)
        self.services.llm.executed(call)
        self._pending[self._key] = Pending(call.tag.episode, due.trial, call.id, due.before)
        lesson = visible(call.text)[0]
        if lesson:
            self._learn(log, due.trial, lesson)
        return call

    def metrics(self) -> dict[str, Any]:
        """What the lesson of the trial before was worth (if there was one), and whether this trial's is `due`."""
        return self._measured | ({"due": True} if self._key in self._due else {})

    def snapshot(self) -> bytes:
        waiting = [{key: asdict(entry) for key, entry in table.items()} for table in (self._due, self._pending)]
        return dump_state([load_state(super().snapshot()), *waiting, self._measured])

    def restore(self, blob: bytes) -> None:
        logs, due, pending, self._measured = load_state(blob)
        super().restore(dump_state(logs))
        self._due = {key: Due(**d) for key, d in due.items()}
        self._pending = {key: Pending(**p) for key, p in pending.items()}
