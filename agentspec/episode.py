"""One episode, and many at once.

Episodes are asyncio tasks on one loop; each owns its agent, its recorder and a worker thread in which its environment
runs under a time limit. Nothing is shared, so results do not depend on how many run at once. An environment that
crashes, hangs or pays NaN makes its own episode ``failed`` and touches no other; so does a module that raises. Only a
specification that cannot work and a defect of the backend itself end the run.
"""

from __future__ import annotations

import asyncio
import math
import queue
import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from agentspec.agent import Agent
from agentspec.envs import environment_id, make_env
from agentspec.llm.base import LLM, ContextOverflowError, LLMError
from agentspec.llm.helpers import helper
from agentspec.llm.none import NoLLM
from agentspec.llm.pricing import Prices
from agentspec.llm.recorder import Recorder, derive_seed
from agentspec.protocols import Embedder
from agentspec.registry import SpecError
from agentspec.simulator import OBJECTS_IN_INFO, EnvironmentFailedError, simulator_of
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory, jsonable, versions
from agentspec.types import Task, Transition

T = TypeVar("T")
MakeEnv = Callable[[Task], Any]


class EnvWorker:
    """A daemon thread that runs one environment's calls in order, each under a time limit.

    A call that exceeds the limit cannot be killed; the worker is then abandoned with its thread.
    """

    def __init__(self, timeout: float | None) -> None:
        self.timeout = timeout
        self._hung = ""
        self._jobs: queue.SimpleQueue[Any] = queue.SimpleQueue()
        threading.Thread(target=self._run, daemon=True, name="agentspec-env").start()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            function, future, loop = job
            try:
                result, error = function(), None
            except BaseException as caught:
                result, error = None, caught
            try:
                loop.call_soon_threadsafe(_resolve, future, result, error)
            except RuntimeError:
                return  # the loop is closed: nobody waits any more

    async def call(self, what: str, function: Callable[[], T]) -> T:
        """Run ``function`` in the worker.

        Raises:
            EnvironmentFailedError: it raised, or took longer than the time limit (seconds).
        """
        if self._hung:
            raise EnvironmentFailedError(f"{what} is not possible any more: {self._hung}")
        loop = asyncio.get_running_loop()
        future: asyncio.Future[T] = loop.create_future()
        self._jobs.put((function, future, loop))
        try:
            return await asyncio.wait_for(future, self.timeout)
        except TimeoutError:
            self._hung = f"{what} took longer than {self.timeout} s"
            raise EnvironmentFailedError(self._hung) from None
        except SpecError:
            raise
        except Exception as error:
            raise EnvironmentFailedError(f"{what} raised {type(error).__name__}: {error}") from error

    def close(self) -> None:
        """Let the thread end after what it is doing."""
        self._jobs.put(None)


def _resolve(future: asyncio.Future[Any], result: Any, error: BaseException | None) -> None:
    if future.done():
        return
    if error is None:
        future.set_result(result)
    else:
        future.set_exception(error)


@dataclass(frozen=True)
class Job:
    """One episode to run: which task, which of its rollouts, and the seed of the run it belongs to."""

    task: Task
    rollout: int = 0
    run_seed: int = 0
    memory_state: bytes | None = None

    @property
    def seed(self) -> int:
        """Seed of everything the agent draws in this episode."""
        return derive_seed(self.run_seed, self.task.key, self.rollout)


@dataclass
class Runner:
    """Runs episodes of one spec against one backend.

    Args:
        spec: the agent.
        llm: the backend; ``None`` only for specs whose modules call no model.
        make_env: task -> environment.
        concurrency: most episodes at once (``None``: all).
        timeout_s: limit of every environment call, in seconds (``None``: none).
        max_steps: most steps of an episode, on top of the environment's own limit.
        policy: label of the policy, for tables.
        on_done: called with each episode when it has ended.
        on_step: called with the task and each step of its episode when it was taken.
        progress: number of jobs -> what to call after each (`agentspec.progress.episode_progress`).
    """

    spec: AgentSpec
    llm: LLM | None = None
    make_env: MakeEnv = make_env
    concurrency: int | None = None
    timeout_s: float | None = 60.0
    max_steps: int | None = None
    prices: Prices = field(default_factory=Prices)
    embedder: Embedder | None = None
    policy: str = ""
    on_done: Callable[[Trajectory], None] | None = None
    on_step: Callable[[Task, Transition], None] | None = None
    progress: Callable[[int], Callable[[Trajectory], None]] | None = None

    def run(self, jobs: Sequence[Job]) -> list[Trajectory]:
        """Run all jobs; trajectories come back in the order of the jobs."""
        return asyncio.run(self.run_async(jobs))

    async def run_async(self, jobs: Sequence[Job]) -> list[Trajectory]:
        """As :meth:`run`, inside a running loop."""
        llm: LLM = self.llm or NoLLM()
        self.spec.check(self._offered(llm) | {"snapshots"}, f"backend {llm.name!r}")
        helpers = {pattern: helper(config) for pattern, config in self.spec.roles.items() if self.spec.helped(pattern)}
        progress = self.progress(len(jobs)) if self.progress else None
        gate = asyncio.Semaphore(self.concurrency or max(1, len(jobs)))

        async def guarded(job: Job) -> Trajectory:
            async with gate:
                trajectory = await self._episode(job, llm, helpers)
            for tell in filter(None, (self.on_done, progress)):
                tell(trajectory)
            return trajectory

        return list(await asyncio.gather(*(guarded(job) for job in jobs)))

    def _offered(self, llm: LLM) -> frozenset[str]:
        """What modules may need and get: of the backend, and of the caller."""
        return frozenset(llm.capabilities) | ({"embedder"} if self.embedder else frozenset())

    async def _episode(self, job: Job, llm: LLM, helpers: Mapping[str, LLM]) -> Trajectory:
        name = f"{job.task.key}-{job.rollout}-{job.seed:x}"
        recorder = Recorder(
            llm,
            episode=name,
            seed=job.seed,
            sampling=self.spec.sampling,
            budget=self.spec.budget,
            prices=self.prices,
            helpers=helpers,
        )
        agent = self.spec.build(recorder, embedder=self.embedder)
        worker = EnvWorker(self.timeout_s)
        llm.enter(name)
        try:
            return await self._play(job, agent, worker)
        finally:
            # Episodes never enter at a helper: it waits for nobody, and nobody waits for it.
            for backend in (llm, *helpers.values()):
                backend.leave(name)
            worker.close()

    async def _play(self, job: Job, agent: Agent, worker: EnvWorker) -> Trajectory:
        if self.spec.scope == "run" and job.memory_state is not None:
            self._resume(agent, job.memory_state)
        transitions: list[Transition] = []
        info: dict[str, Any] = {}
        status, error, ended = "completed", "", "environment"
        env = None
        try:
            env = await worker.call("make", lambda: self.make_env(job.task))
            simulator = simulator_of(env, worker, job.task, agent.perception)
            if simulator is None:
                who = f"environment {job.task.env!r} without snapshot() and restore()"
                self.spec.check(self._offered(agent.recorder.llm), who)
            agent.attach_simulator(simulator)
            observation, info = await worker.call("reset", lambda: env.reset(seed=job.task.seed))
            agent.begin_episode(job.task)
            while not (transitions and (transitions[-1].terminated or transitions[-1].truncated)):
                if self.max_steps is not None and len(transitions) >= self.max_steps:
                    ended = "max_steps"
                    break
                transition, observation, info = await _step(job.task, agent, env, worker, observation, info)
                if transition is None:
                    ended = "budget"
                    break
                transitions.append(transition)
                if self.on_step:
                    self.on_step(job.task, transition)
                await agent.learn(transition)
        except ContextOverflowError as caught:
            ended, error = "context", str(caught)
        except Exception as caught:
            status, error, ended = "failed", _failure(caught, agent), "failure"
        finally:
            if env is not None and status == "completed":
                await worker.call("close", env.close)
        metrics = {**jsonable(info.get("metrics", {})), **_scaffold_metrics(transitions, agent.recorder, ended)}
        trajectory = self._trajectory(job, transitions, agent, metrics, status, error)
        if status == "completed":
            try:
                await agent.end_episode(trajectory)
            except Exception as caught:
                status, error, ended = "failed", _failure(caught, agent), "failure"
            metrics |= _scaffold_metrics(transitions, agent.recorder, ended) | jsonable(agent.metrics())
            trajectory = self._trajectory(job, transitions, agent, metrics, status, error)
        return trajectory

    def _resume(self, agent: Agent, state: bytes) -> None:
        try:
            agent.resume(state)
        except Exception as error:  # whatever a module does with a state that is not its own
            modules = f"memory {self.spec.memory.name!r} and reflection {self.spec.reflection.name!r}"
            raise SpecError(
                f"the carried state cannot be taken up by {modules} ({type(error).__name__}: {error}); was it "
                "edited, or written by another version? grow the memory again"
            ) from error

    def _trajectory(
        self,
        job: Job,
        transitions: Sequence[Transition],
        agent: Agent,
        metrics: dict[str, Any],
        status: str,
        error: str,
    ) -> Trajectory:
        return Trajectory(
            task=job.task,
            spec=self.spec.to_data(),
            rollout=job.rollout,
            seed=job.seed,
            policy=self.policy,
            transitions=tuple(transitions),
            calls=tuple(sorted(agent.recorder.calls, key=lambda c: c.id)),
            metrics=metrics,
            status=status,
            error=error,
            versions=versions(),
            memory_state=agent.carry() if self.spec.scope == "run" else None,
        )


async def _step(
    task: Task, agent: Agent, env: Any, worker: EnvWorker, observation: Any, info: dict[str, Any]
) -> tuple[Transition | None, Any, dict[str, Any]]:
    """Decide and act once; no transition when the budget is exhausted."""
    agent_input, decision = await agent.decide(task, observation, info)
    if "budget" in decision.trace:
        return None, observation, info
    text = decision.action.text
    deliberate = getattr(getattr(env, "unwrapped", env), "deliberate", None)
    if callable(deliberate):
        # Environments that charge for thinking are told of every call since the step before, memory's included.
        calls = agent.uncharged()
        tokens = sum(call.usage.output_tokens for call in calls)
        await worker.call("deliberate", lambda: deliberate(len(calls), tokens))
    observation, reward, terminated, truncated, info = await worker.call("step", lambda: env.step(text))
    if not math.isfinite(float(reward)):
        raise EnvironmentFailedError(f"step returned reward {reward} for action {text!r}; rewards must be finite")
    transition = Transition(
        step=agent.clock.step,
        input=agent_input,
        decision=decision,
        action_text=text,
        reward=float(reward),
        next_text=observation["text"],
        terminated=bool(terminated),
        truncated=bool(truncated),
        info={k: jsonable(v) for k, v in info.items() if k not in OBJECTS_IN_INFO},
    )
    return transition, observation, info


def _failure(error: Exception, agent: Agent) -> str:
    """Why an episode failed: its environment, its model, or a module that raised (with the place where).

    Raises:
        Exception: `error` itself, where it is a specification that cannot work or a defect of the backend.
    """
    if isinstance(error, EnvironmentFailedError | LLMError):
        return str(error)
    if isinstance(error, SpecError) or error is agent.recorder.backend_error:
        raise error
    frame = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{Path(frame.filename).name}:{frame.lineno}, in {frame.name}: {frame.line}"
    return f"a module raised {type(error).__name__}: {error} ({where})"


def _scaffold_metrics(transitions: Sequence[Transition], recorder: Recorder, ended: str) -> dict[str, Any]:
    """What the scaffold adds to the environment's figures; ``thinking_s`` is wall-clock time of the model calls."""
    usage, steps = recorder.usage, len(transitions)
    return {
        "steps": steps,
        "return": sum(t.reward for t in transitions),
        "invalid_actions": sum(bool(t.info.get("invalid")) or not t.decision.valid for t in transitions),
        "fallbacks": sum("fallback" in t.decision.trace for t in transitions),
        "exhausted_searches": sum(bool(t.decision.trace.get("exhausted")) for t in transitions),
        "llm_calls": len(recorder.calls),
        "scorings": recorder.scorings,
        "input_tokens": usage.input_tokens,
        "output_tokens": usage.output_tokens,
        "cached_tokens": usage.cached_tokens,
        "cost": usage.cost,
        "thinking_s": sum(c.latency_s for c in recorder.calls),
        "problems": sum(recorder.problems.values()),
        "ended": ended,
    }


__all__ = ["EnvWorker", "EnvironmentFailedError", "Job", "NoLLM", "Runner", "environment_id", "make_env"]
