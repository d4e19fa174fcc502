"""Retroformer (Yao et al., 2024): a reflector that is a policy of its own, trained on what its reflections are worth.

It acts like Reflexion: a retrospective model reads a failed trial, its return and the earlier lessons, and writes a
lesson that stands in the actor's prompts. What makes it Retroformer is the training: the actor is frozen, and a lesson
is paid the change of return it brought, ``G(next trial) - G(this trial)``.

*As it comes the reflector is untrained*: it is the policy's own weights, and the module measures what training needs.
The call that writes a lesson is tagged ``reflection.retroformer/reflect`` and credited as executed; its reward is known
one trial later and is recorded in *that* trial's metrics (``reflection/reward`` and whose call it pays).
:func:`reflection_samples` joins the two: prompt and completion from the trial that was reflected on, reward from the
next. A trainer optimises these calls alone (``train_calls: [reflection.retroformer/reflect]``, a reflector adapter
beside a frozen actor adapter); samples of one ``group`` reflect on the same failed trial and are each followed by a
trial of their own, so their rewards compare like with like.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from agentspec.protocols import Services
from agentspec.reflection.reflexion import Reflexion
from agentspec.reflection.trials import episode_return
from agentspec.state import dump_state, load_state
from agentspec.trajectory import Trajectory
from agentspec.types import LLMCall, Task

PATH = "reflection.retroformer/reflect"


@dataclass(frozen=True)
class Pending:
    """A lesson whose worth is not known yet: which call of which trial wrote it, and that trial's return."""

    episode: str
    trial: int
    call: int
    before: float


@dataclass(frozen=True)
class ReflectionSample:
    """One training example of the reflector.

    Args:
        group: name of the prompt: samples of one group reflect on the same failed trial.
        call: the call that wrote the lesson.
        reward: change of return from the trial reflected on to the next.
    """

    group: str
    call: LLMCall
    reward: float


class Retroformer(Reflexion):
    """Lessons from failed trials, and the bookkeeping of what each was worth.

    Args:
        max_prompt_updates: lessons shown to the actor, the newest ones.
        threshold, max_repeats, key, reflection_tokens, trial_tokens: as in
            :class:`~agentspec.reflection.reflexion.Reflexion`.
    """

    name = "retroformer"

    def __init__(
        self,
        services: Services,
        max_prompt_updates: int = 3,
        threshold: float | None = None,
        max_repeats: int = 0,
        key: str = "task",
        reflection_tokens: int = 128,
        trial_tokens: int = 1024,
    ) -> None:
        super().__init__(services, max_prompt_updates, threshold, max_repeats, key, reflection_tokens, trial_tokens)
        self._pending: dict[str, Pending] = {}
        self._measured: dict[str, Any] = {}

    def begin_episode(self, task: Task) -> None:
        super().begin_episode(task)
        self._measured = {}

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
        trial = self._logs[self._key].trials if self._key in self._logs else 0
        call = await self.reflect(trajectory)
        if call is not None:
            self.services.llm.executed(call)
            self._pending[self._key] = Pending(trajectory.episode, trial, call.id, total)

    def metrics(self) -> dict[str, Any]:
        """What the lesson of the trial before was worth; empty if there was none."""
        return dict(self._measured)

    def snapshot(self) -> bytes:
        pending = {key: asdict(p) for key, p in self._pending.items()}
        return dump_state([load_state(super().snapshot()), pending, self._measured])

    def restore(self, blob: bytes) -> None:
        logs, pending, self._measured = load_state(blob)
        super().restore(dump_state(logs))
        self._pending = {key: Pending(**p) for key, p in pending.items()}


def reflection_samples(trajectories: Iterable[Trajectory]) -> list[ReflectionSample]:
    """The reflector's training examples in a stream of trials, in the order their rewards became known.

    Args:
        trajectories: trials in the order they were played; a lesson whose trial is not among them is left out.
    """
    written: dict[tuple[str, int], LLMCall] = {}
    samples = []
    for trajectory in trajectories:
        paid = trajectory.metrics
        call = written.get((str(paid.get("reflection/episode")), int(paid.get("reflection/call", -1))))
        if call is not None:
            group = hashlib.sha256(repr(call.prompt_ids).encode()).hexdigest()[:12]
            samples.append(ReflectionSample(group, call, float(paid["reflection/reward"])))
        written |= {(trajectory.episode, c.id): c for c in trajectory.calls if c.tag.path == PATH}
    return samples
