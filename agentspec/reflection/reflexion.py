"""Reflexion (Shinn et al., 2023): after a failed trial, a lesson in words for the next one.

At the end of a failed episode the model reads the trial, its return and the earlier lessons, and writes what to do
differently; the last `max_reflections` lessons stand in every prompt of the next trials. There is no reflection after a
success, and none within an episode. What counts as failure is said in `agentspec.reflection.trials.failed`: where a
task is graded and not simply won or lost, a trial that does not beat the best one so far.

Lessons outlive the episode, so the method needs `scope: run`; with `scope: episode` it would pay for lessons that
nobody reads, and is refused. They belong to one task and seed; for streams of unseen tasks, `key="family"` shares them
among all tasks of the same world and options. Cost: no call per step, one per failed episode.
"""

from __future__ import annotations

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message
from agentspec.parameters import at_least, one_of
from agentspec.reflection.trials import KEYS, TrialLog, episode_return, failed, key_of, trial_prompt
from agentspec.services import Services
from agentspec.state import dump_state, load_state
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Decision, LLMCall, Recall, Task

REFLECT = (
    "This trial was not good enough. Which decisions cost the most, and what will you do differently next time? Name "
    "the steps and the actions to take in their place. Write two to four short sentences, addressed to yourself."
)


class Reflexion:
    """Lessons from failed trials.

    Args:
        max_reflections: lessons shown, the newest ones.
        threshold: returns below are failures (`None`: returns below the best so far).
        max_repeats: the same unrewarded action this often in a row is a failure (0: not looked at).
        key: `task` or `family`.
        reflection_tokens: most tokens of a lesson.
        trial_tokens: budget of the trial's steps in the reflector's prompt.
        control: a text that stands in for every lesson, and no model call: what a lesson must be better than.
    """

    declaration = Declaration(
        "after a failed trial a lesson in words, shown in the next trials of the same task",
        calls=CallProfile(episode=(0, 1)),
        scope="run",
        purposes={"reflect": Purpose("episode")},
    )

    name = "reflexion"

    def __init__(
        self,
        services: Services,
        max_reflections: int = 3,
        threshold: float | None = None,
        max_repeats: int = 0,
        key: str = "task",
        reflection_tokens: int = 256,
        trial_tokens: int = 1024,
        control: str = "",
    ) -> None:
        at_least(self.name, 1, max_reflections=max_reflections, reflection_tokens=reflection_tokens)
        at_least(self.name, 0, max_repeats=max_repeats)
        one_of(self.name, key=(key, KEYS))
        self.services = services
        self.max_reflections = max_reflections
        self.threshold = threshold
        self.max_repeats = max_repeats
        self.by = key
        self.reflection_tokens = reflection_tokens
        self.trial_tokens = trial_tokens
        self.control = control
        self._logs: dict[str, TrialLog] = {}
        self._key = ""

    def begin_episode(self, task: Task) -> None:
        self._key = key_of(task, self.by)

    async def lessons(self, input: AgentInput) -> Recall:
        log = self._logs.get(self._key)
        return log.recall(self.max_reflections, f"reflection.{self.name}") if log else Recall()

    async def revise(self, input: AgentInput, recall: Recall, decision: Decision) -> Decision:
        return decision

    async def end_episode(self, trajectory: Trajectory) -> None:
        """Count the trial; if it failed, learn from it."""
        await self.reflect(trajectory)

    async def reflect(self, trajectory: Trajectory) -> LLMCall | None:
        """The call that wrote a lesson, or `None` if there was nothing to learn or nothing came of it."""
        log = self._logs.setdefault(self._key, TrialLog())
        total = episode_return(trajectory)
        learns = bool(trajectory.transitions) and failed(trajectory, log.best, self.threshold, self.max_repeats)
        call = None
        try:
            if learns:
                call = await self._ask(trajectory, log)
        finally:  # the trial counts, whether or not the budget allowed a lesson
            log.best = total if log.best is None else max(log.best, total)
            log.trials += 1
        return call

    def _learn(self, log: TrialLog, trial: int, lesson: str) -> None:
        log.lessons = [*log.lessons, (trial, " ".join(lesson.split()))][-self.max_reflections :]

    def _prompt(self, trajectory: Trajectory, log: TrialLog) -> tuple[Message, ...]:
        return trial_prompt(trajectory, log, self.max_reflections, REFLECT, self.trial_tokens, self.services)

    async def _ask(self, trajectory: Trajectory, log: TrialLog) -> LLMCall | None:
        if self.control:
            self._learn(log, log.trials, self.control)
            return None
        answer = await self.services.ask("reflect", self._prompt(trajectory, log), self.reflection_tokens)
        if answer.value:
            self._learn(log, log.trials, answer.value)
        return answer.call if answer.value else None

    def snapshot(self) -> bytes:
        return dump_state({key: log.to_data() for key, log in self._logs.items()})

    def restore(self, blob: bytes) -> None:
        self._logs = {key: TrialLog.from_data(data) for key, data in load_state(blob).items()}
