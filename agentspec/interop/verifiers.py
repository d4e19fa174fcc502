"""Worlds as a verifiers taskset, and a scaffold as a verifiers harness (the `verifiers.v1` interface).

    vf-eval agentspec-verifiers --env.taskset.world minigrid --env.taskset.options '{"suite": "paper"}' -n 10 ...
    vf-eval agentspec-verifiers --env.player.harness.id agentspec-verifiers --env.player.harness.scaffold react.yaml ...

`WorldTaskset` makes a task of each seed; `WorldEnv` plays the world as the user of a conversation: it shows the first
observation, reads each reply as an action and answers with the next observation, in process, for whatever harness sits
in the seat. `ScaffoldHarness` sits there itself and plays the whole episode with one of this package's agents, every
model call of which goes through verifiers' endpoint and is in its trace.

Needs `pip install 'agentspec-rl[verifiers]'`. Plugins are found by a top-level module's name: `agentspec_verifiers`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import verifiers.v1 as vf

from agentspec.episode import Job, Runner
from agentspec.interop.game import Game
from agentspec.llm.openai import OpenAILLM
from agentspec.metrics import number
from agentspec.prompting import default_answer, static_prompt
from agentspec.spec import AgentSpec
from agentspec.tasks import make_tasks
from agentspec.types import AgentInput, Task

OUTCOME = "agentspec"
"""Key of a trace's `info` that holds score and metrics of the episode."""


class WorldConfig(vf.TasksetConfig):
    """What is played."""

    world: str = "minigrid"
    """A registered environment or a gymnasium id."""
    options: dict[str, Any] = {}  # noqa: RUF012
    """Of the environment."""
    split: str = "test"
    """Range of seeds: `train`, `validation` or `test`."""
    count: int = 100
    """Number of tasks."""
    score: str = "return"
    """What is the reward: the sum of the environment's rewards (`return`), or one of its metrics (`success`, ...)."""


class WorldData(vf.TaskData):
    """One episode: environment, options and seed."""

    world: str
    options: dict[str, Any]
    seed: int
    score: str


class WorldTask(vf.Task[WorldData, vf.State, vf.TaskConfig]):
    """Scores what `WorldEnv` or `ScaffoldHarness` left in the trace."""

    @vf.reward
    async def outcome(self, trace: vf.Trace) -> float:
        """The taskset's score of the episode."""
        return float(_outcome(trace)["score"])

    @vf.metric
    async def figures(self, trace: vf.Trace) -> Mapping[str, float]:
        """The environment's metrics, and the number of steps."""
        figures: Mapping[str, float] = _outcome(trace)["metrics"]
        return figures


class WorldTaskset(vf.Taskset[WorldTask, WorldConfig]):
    """A task per seed; the first observation is its prompt, the static part the system prompt."""

    def load(self) -> Iterator[WorldTask]:
        """The tasks, made as they are asked for."""
        config = self.config
        game = Game(config.world, config.options)
        for task in make_tasks(config.world, config.options, config.count, split=config.split):
            text = game.start(task.seed)
            game.score(config.score)
            data = WorldData(
                name=f"{config.world}-{task.seed}",
                prompt=text,
                system_prompt=_static(game),
                world=config.world,
                options=config.options,
                seed=task.seed,
                score=config.score,
            )
            yield WorldTask(data, config.task)
        game.close()


class ScaffoldConfig(vf.HarnessConfig):
    """Which agent plays."""

    scaffold: Path | None = None
    """YAML file of an agent spec; none: the package's default agent."""


class ScaffoldHarness(vf.Harness[ScaffoldConfig]):
    """Plays a world's whole episode with an agent of this package, in process."""

    APPENDS_SYSTEM_PROMPT = True
    EXECUTES_CODE = False
    NEEDS_CONTAINER = False

    async def launch(
        self,
        ctx: vf.ModelContext,
        trace: vf.Trace,
        runtime: vf.Runtime,
        endpoint: str,
        secret: str,
        mcp_urls: dict[str, str],
        data: vf.TaskData,
        **_: Any,
    ) -> vf.ProgramResult:
        """One episode; what it came to is left in `trace.info`.

        Raises:
            HarnessError: a task that is not a `WorldTaskset`'s.
        """
        if not isinstance(data, WorldData):
            raise vf.HarnessError(
                f"the harness {self.config.id!r} plays tasks of agentspec-verifiers, got {type(data)}"
            )
        spec = AgentSpec.from_yaml(self.config.scaffold) if self.config.scaffold else AgentSpec()
        llm = OpenAILLM(ctx.model, base_url=endpoint, api_key=secret, max_retries=0)
        try:
            episode = (await Runner(spec, llm).run_async([Job(Task(data.world, data.seed, data.options))]))[0]
        finally:
            await llm.aclose()
        if not episode.scorable:
            return vf.ProgramResult(exit_code=1, stdout="", stderr=episode.error)
        metrics = {name: value for name, value in map(_number, episode.metrics.items()) if value is not None}
        trace.info[OUTCOME] = {"score": metrics.get(data.score, 0.0), "metrics": metrics}
        return vf.ProgramResult(exit_code=0, stdout="", stderr="")


class WorldEnvConfig(vf.EnvConfig):
    """Who plays."""

    player: vf.AgentConfig = vf.AgentConfig(harness={"id": "null"}, runtime={"type": "subprocess"})


class WorldEnv(vf.Env[WorldEnvConfig]):
    """The world in the user's seat."""

    async def run(self, task: WorldTask, agents: vf.Agents) -> None:
        """One episode, until it ends or the player does."""
        if isinstance(agents.player.harness, ScaffoldHarness):
            await agents.player.run(task)
            return
        game = await asyncio.to_thread(Game, task.data.world, task.data.options)
        try:
            await asyncio.to_thread(game.start, task.data.seed)
            async with agents.player.interaction(task) as interaction:
                segment = await interaction.turn()
                while not segment.terminated:
                    seen = await asyncio.to_thread(game.act, segment.last_reply)
                    if game.over:
                        break
                    segment = await interaction.turn(seen)
                figures = game.metrics | {"steps": float(game.steps)}
                interaction.trace.info[OUTCOME] = {"score": game.score(task.data.score), "metrics": figures}
        finally:
            game.close()


def _static(game: Game) -> str:
    """What an agent of this package shows first: rules, actions, how to answer."""
    return static_prompt(AgentInput(game.instruction, "", game.schema), default_answer(game.schema))


def _number(item: tuple[str, Any]) -> tuple[str, float | None]:
    return item[0], number(item[1])


def _outcome(trace: vf.Trace) -> Mapping[str, Any]:
    if OUTCOME not in trace.info:
        raise vf.TaskError(
            "nobody played this episode's world; leave the environment to the taskset (no --env.id), "
            "or let the harness agentspec-verifiers play"
        )
    found: Mapping[str, Any] = trace.info[OUTCOME]
    return found
