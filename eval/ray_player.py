"""Episodes on other processes and machines, through Ray (`pip install 'agentspec-rl[ray]'`).

Each worker is an actor with one copy of the policy's model; it plays many episodes at once, which share its batches.
The driver hands episodes to the worker with the fewest under way and alone writes the store, so a worker that dies
loses the episodes it was playing and nothing else: they are played again by another one.
"""

from __future__ import annotations

import asyncio
import sys
from types import TracebackType
from typing import Any

from agentspec.episode import Job, MakeEnv
from agentspec.policies import Policy
from agentspec.registry import SpecError
from eval.cells import Cell, Settings
from eval.play import LocalPlayer, MakeLLM, Played

MOST_DEATHS = 3
"""An episode whose worker died this often is not tried again: it may be what kills them."""


class Worker:
    """What runs in a Ray actor: a model and the episodes it plays."""

    def __init__(self, policy: Policy, settings: Settings, make_llm: MakeLLM | None, make_env: MakeEnv) -> None:
        self.player = LocalPlayer((make_llm or Policy.build)(policy), settings, make_env)

    async def play(self, cell: Cell, job: Job) -> Played:
        """As `LocalPlayer.play`."""
        return await self.player.play(cell, job)

    async def pid(self) -> int:
        """Of the worker's process."""
        import os

        return os.getpid()


class RayPlayer:
    """A `Player` with several workers; a context manager that ends them.

    Args:
        workers: number of processes, with one model each.
        address: of a cluster (`ray://...`, `auto`); empty: processes on this machine, for this evaluation only.

    Raises:
        SpecError: Ray is not installed.
    """

    def __init__(
        self,
        policy: Policy,
        settings: Settings,
        workers: int,
        address: str,
        make_llm: MakeLLM | None,
        make_env: MakeEnv,
    ) -> None:
        if workers < 1:
            raise SpecError(f"workers must be at least 1, got {workers}")
        try:
            import ray
        except ImportError:
            raise SpecError("--executor ray needs Ray: pip install 'agentspec-rl[ray]'") from None
        if not ray.is_initialized():
            ray.init(
                address=address or "local",
                log_to_driver=False,
                include_dashboard=False,
                runtime_env={"env_vars": _environment()},
            )
        self._ray = ray
        self._arguments = (policy, settings, make_llm, make_env)
        self._actors = [self._start() for _ in range(workers)]
        self._busy = [0] * workers

    def _start(self) -> Any:
        # No restarts by Ray: what was lost is known here, and played again by whoever is free.
        actor = self._ray.remote(Worker).options(max_concurrency=1000, num_cpus=0, max_restarts=0)
        return actor.remote(*self._arguments)

    async def play(self, cell: Cell, job: Job) -> Played:
        """Play one episode on some worker.

        Raises:
            RuntimeError: the workers that played it died, `MOST_DEATHS` times.
        """
        from ray.exceptions import RayActorError

        why = ""
        for _ in range(MOST_DEATHS):
            i = min(range(len(self._actors)), key=self._busy.__getitem__)
            actor = self._actors[i]
            self._busy[i] += 1
            try:
                played: Played = await asyncio.wrap_future(actor.play.remote(cell, job).future())
                return played
            except RayActorError as error:
                why = " ".join(str(error).split())[-300:]  # its end says what the worker raised, a model not found say
                if self._actors[i] is actor:  # the first of its episodes to notice starts another
                    print(f"a worker died ({type(error).__name__}); starting another", file=sys.stderr, flush=True)
                    self._actors[i] = self._start()
            finally:
                self._busy[i] -= 1
        raise RuntimeError(f"{MOST_DEATHS} workers died while they played {job.task.key}: {why}")

    def __enter__(self) -> RayPlayer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for actor in self._actors:
            self._ray.kill(actor)


def _environment() -> dict[str, str]:
    """What workers need to find the same code: modules that stand beside this process and are not installed."""
    import os

    return {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
