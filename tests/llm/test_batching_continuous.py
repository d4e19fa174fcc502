"""Who is in each step of the work, and that nobody waits for ever or goes on too early."""

from __future__ import annotations

import asyncio
import random
import threading
from collections.abc import Sequence
from typing import Any, get_args

import pytest

from agentspec.llm.batching import Batcher, Batching


class Steps:
    """A ``run`` that takes as many steps for a job as its name says (``a0:3`` takes three); keeps who was in each."""

    def __init__(self, batching: Batching, **kwargs: Any) -> None:
        self.batcher: Batcher[str] = Batcher(self, batching=batching, **kwargs)
        self.steps: list[str] = []
        self.running = False
        self.fail_at = self.hold_at = -1
        self.go_on = threading.Event()
        self.ended = threading.Event()

    def __call__(self, jobs: Sequence[str]) -> None:
        self.running = True
        try:
            left = {job: length(job) for job in jobs}
            while left:
                self.steps.append(" ".join(sorted(job.split(":")[0] for job in left)))
                if len(self.steps) == self.fail_at:
                    raise RuntimeError("broken")
                if len(self.steps) == self.hold_at:
                    assert self.go_on.wait(20)
                left = {job: n - 1 for job, n in left.items()}
                done = [job for job, n in left.items() if n == 0]
                left = {job: n for job, n in left.items() if n}
                left |= {job: length(job) for job in self.batcher.exchange(done)}
        finally:
            self.running = False
            self.ended.set()


def length(job: str) -> int:
    return int(job.split(":")[1])


async def play(batcher: Batcher[str], name: str, lengths: Sequence[int], pause_s: float = 0.0) -> None:
    """An episode that asks once per length and acts in between."""
    batcher.enter(name)
    try:
        for turn, n in enumerate(lengths):
            await batcher.submit(name, turn, f"{name}{turn}:{n}")
            if pause_s:
                await asyncio.sleep(pause_s)
    finally:
        batcher.leave(name)


def run(coroutine: Any) -> Any:
    return asyncio.run(asyncio.wait_for(coroutine, timeout=20))


def steps_of(batching: Batching, episodes: dict[str, Sequence[int]]) -> list[str]:
    machine = Steps(batching)

    async def main() -> None:
        await asyncio.gather(*[play(machine.batcher, e, n) for e, n in episodes.items()])

    run(main())
    return machine.steps


def test_an_answer_is_delivered_at_once_and_its_episode_asks_again_beside_the_others() -> None:
    episodes = {"a": [1, 2, 1], "b": [3, 1]}
    # a asks again after its first step; both are answered after the third.
    assert steps_of("continuous", episodes) == ["a0 b0", "a1 b0", "a1 b0", "a2 b1"]
    assert steps_of("closed", episodes) == ["a0 b0", "b0", "b0", "a1 b1", "a1", "a2"]


@pytest.mark.parametrize("at_once", [3, 8])
def test_who_is_in_a_closed_batch_does_not_depend_on_timing(at_once: int) -> None:
    """Also with episodes that begin as others end."""
    draw = random.Random(0)
    episodes = {e: [draw.randint(1, 6) for _ in range(draw.randint(1, 4))] for e in "abcdefgh"}

    def timed(seed: int) -> list[str]:
        machine, times = Steps("closed"), random.Random(seed)

        async def main() -> None:
            gate = asyncio.Semaphore(at_once)

            async def guarded(name: str) -> None:
                async with gate:
                    await play(machine.batcher, name, episodes[name], times.choice([0.0, 0.001, 0.005]))

            await asyncio.gather(*map(guarded, episodes))

        run(main())
        return machine.steps

    first = timed(0)
    assert [timed(seed) for seed in (1, 2, 3)] == [first] * 3
    assert sum(len(step.split()) for step in first) == sum(map(sum, episodes.values()))


def test_a_continuous_batch_waits_for_nobody() -> None:
    machine = Steps("continuous")

    async def main() -> None:
        a_is_over = asyncio.Event()

        async def slow() -> None:
            machine.batcher.enter("b")
            await a_is_over.wait()
            machine.batcher.leave("b")

        async def quick() -> None:
            await play(machine.batcher, "a", [1, 1, 1])
            a_is_over.set()

        await asyncio.gather(slow(), quick(), play(machine.batcher, "c", [50]))

    run(main())
    assert machine.steps[0] == "a0 c0"
    assert {"a1 c0", "a2 c0"} <= set(machine.steps)


@pytest.mark.parametrize("share", [0.0, 1e9])
def test_those_answered_together_ask_together_however_many_turns_their_acting_takes(
    share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As long as there is time; without any they drift apart for good."""
    monkeypatch.setattr("agentspec.llm.batching._SHARE", share)
    machine = Steps("continuous")

    async def acting(name: str, turns: int) -> None:
        machine.batcher.enter(name)
        try:
            for i in range(3):
                await machine.batcher.submit(name, i, f"{name}{i}:2")
                for _ in range(turns * i):
                    await asyncio.sleep(0)
        finally:
            machine.batcher.leave(name)

    async def main() -> None:
        await asyncio.gather(acting("a", 0), acting("b", 40), acting("c", 90))

    run(main())
    together = machine.steps == [f"a{i} b{i} c{i}" for i in (0, 0, 1, 1, 2, 2)]
    assert together == (share > 0)


def test_an_episode_that_has_more_under_way_or_left_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agentspec.llm.batching._SHARE", 1e9)
    machine = Steps("continuous")

    async def several() -> None:
        machine.batcher.enter("a")
        await asyncio.gather(*(machine.batcher.submit("a", i, f"a{i}:{2 * i + 1}") for i in range(2)))
        machine.batcher.leave("a")

    async def main() -> None:
        await asyncio.gather(several(), play(machine.batcher, "b", [2, 1, 3]))

    run(main())
    assert machine.steps == ["a0 a1 b0", "a1 b0", "a1 b1", "b2", "b2", "b2"]


def test_what_one_episode_asks_at_once_is_answered_as_it_is_finished() -> None:
    machine = Steps("continuous")
    answered: list[str] = []

    async def ask(number: int, n: int) -> None:
        await machine.batcher.submit("a", number, f"a{number}:{n}")
        answered.append(f"a{number} after {len(machine.steps)}")

    async def several() -> None:
        machine.batcher.enter("a")
        await asyncio.gather(ask(0, 1), ask(1, 3))
        machine.batcher.leave("a")

    async def main() -> None:
        await asyncio.gather(several(), play(machine.batcher, "b", [2, 4]))

    run(main())
    assert machine.steps == ["a0 a1 b0", "a1 b0", "a1 b1", "b1", "b1", "b1"]
    assert answered == ["a0 after 1", "a1 after 3"]


def test_a_stranger_joins_and_waits_for_nobody() -> None:
    machine = Steps("continuous")

    async def stranger() -> None:
        for turn in range(3):
            await machine.batcher.submit("", turn, f"s{turn}:1")

    async def main() -> None:
        machine.batcher.enter("acting")  # never asks
        await asyncio.gather(stranger(), machine.batcher.submit("", 9, "t:3"))
        machine.batcher.leave("acting")

    run(main())
    assert machine.steps == ["s0 t", "s1 t", "s2 t"]


@pytest.mark.parametrize("batching", get_args(Batching))
def test_strangers_who_ask_all_the_time_do_not_keep_the_episodes_out(batching: Batching) -> None:
    machine = Steps(batching)

    async def main() -> None:
        over = asyncio.Event()

        async def stranger(number: int) -> None:
            while not over.is_set():
                await machine.batcher.submit("", number, f"s{number}:{number}")

        async def live() -> None:
            await play(machine.batcher, "a", [1, 2])
            over.set()

        machine.batcher.enter("a")  # so that the strangers begin without it
        strangers = [asyncio.create_task(stranger(n)) for n in (2, 3)]
        await asyncio.sleep(0.01)
        machine.batcher.leave("a")
        await asyncio.gather(live(), *strangers)

    run(main())
    assert [step.split()[0] for step in machine.steps if "a" in step] == ["a0", "a1", "a1"]


@pytest.mark.parametrize("batching", get_args(Batching))
def test_the_last_go_on_only_when_nothing_is_under_way(batching: Batching) -> None:
    """Who has the last answer may change the model: the worker must be through with it."""
    machine = Steps(batching)
    running: list[bool] = []

    async def main() -> None:
        await asyncio.gather(play(machine.batcher, "a", [1, 1]), play(machine.batcher, "b", [4]))
        running.append(machine.running)

    for _ in range(5):
        run(main())
    assert running == [False] * 5


def test_a_failure_reaches_those_in_the_batch_only() -> None:
    machine = Steps("continuous")
    machine.fail_at = 2

    async def main() -> list[Any]:
        episodes = [play(machine.batcher, e, n) for e, n in {"a": [1], "b": [3], "c": [2, 1]}.items()]
        return list(await asyncio.gather(*episodes, return_exceptions=True))

    a, b, c = run(main())
    assert a is None
    assert [str(b), str(c)] == ["broken", "broken"]
    run(play(machine.batcher, "d", [1]))
    assert machine.steps == ["a0 b0 c0", "b0 c0", "d0"]


def test_an_episode_cancelled_in_the_batch_does_not_hold_the_others() -> None:
    machine = Steps("continuous")
    machine.hold_at = 2

    async def main() -> None:
        a = asyncio.create_task(play(machine.batcher, "a", [4], pause_s=3600))
        b = asyncio.create_task(play(machine.batcher, "b", [1, 1, 5]))
        while len(machine.steps) < 2:
            await asyncio.sleep(0.001)
        a.cancel()
        await asyncio.sleep(0.02)
        machine.go_on.set()
        await b

    run(main())
    assert machine.steps == ["a0 b0", "a0 b1", "a0 b2", "a0 b2", "b2", "b2", "b2"]


def test_a_batch_nobody_waits_for_ends_and_the_next_loop_starts_clean() -> None:
    machine = Steps("continuous")

    async def never_leaves() -> None:
        machine.batcher.enter("a")
        never_ends = asyncio.create_task(play(machine.batcher, "b", [10**9]))
        await machine.batcher.submit("a", 0, "a0:1")
        await asyncio.sleep(0.01)
        never_ends.cancel()

    run(never_leaves())
    assert machine.ended.wait(20)
    machine.steps.clear()
    run(play(machine.batcher, "c", [1]))
    assert machine.steps == ["c0"]


def test_an_unknown_way_of_batching_is_refused() -> None:
    with pytest.raises(ValueError, match="batching is 'sometimes'; expected one of continuous, closed"):
        Steps("sometimes")  # type: ignore[arg-type]
