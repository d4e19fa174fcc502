"""Batches run when every live episode waits, in a fixed order, and nobody is ever left waiting."""

from __future__ import annotations

import asyncio

import pytest

from agentspec.llm.batching import Batcher


class Log:
    """A ``run`` that keeps what it was given."""

    def __init__(self) -> None:
        self.batches: list[list[str]] = []
        self.fail = False

    def __call__(self, jobs):
        self.batches.append(list(jobs))
        if self.fail:
            raise RuntimeError("broken")


async def play(batcher: Batcher[str], name: str, turns: int, pause: int = 0) -> None:
    batcher.enter(name)
    try:
        for turn in range(turns):
            for _ in range(pause):
                await asyncio.sleep(0)
            await batcher.submit(name, turn, f"{name}{turn}")
    finally:
        batcher.leave(name)


def run(coroutine):
    return asyncio.run(asyncio.wait_for(coroutine, timeout=20))


def test_batches_hold_every_live_episode_in_order_whatever_their_pace():
    log = Log()
    batcher = Batcher(log)

    async def main():
        await asyncio.gather(play(batcher, "b", 2, pause=9), play(batcher, "a", 3, pause=1), play(batcher, "c", 1))

    run(main())
    assert log.batches == [["a0", "b0", "c0"], ["a1", "b1"], ["a2"]]


def test_without_live_episodes_requests_run_at_once():
    log = Log()
    batcher = Batcher(log)

    async def main():
        await asyncio.gather(*[batcher.submit("", i, f"j{i}") for i in (1, 0)])

    run(main())
    assert log.batches == [["j0", "j1"]]


def test_several_requests_of_one_episode_run_together():
    log = Log()
    batcher = Batcher(log)

    async def late(number: int) -> None:
        await asyncio.sleep(0)
        await batcher.submit("a", number, f"a{number}")

    async def main():
        batcher.enter("a")
        await asyncio.gather(*[late(i) for i in (2, 0, 1)])

    run(main())
    assert log.batches == [["a0", "a1", "a2"]]


def test_a_stranger_does_not_wait_for_live_episodes():
    log = Log()
    batcher = Batcher(log)

    async def main():
        batcher.enter("thinking")
        await batcher.submit("", 0, "score")

    run(main())
    assert log.batches == [["score"]]


@pytest.mark.parametrize("how", ["leave", "cancel", "crash"])
def test_an_episode_that_goes_away_does_not_hold_the_others(how):
    log = Log()
    batcher = Batcher(log)

    async def goes_away():
        batcher.enter("a")
        if how == "crash":
            raise ValueError("environment")
        await asyncio.sleep(0.01 if how == "leave" else 3600)
        batcher.leave("a")

    async def main():
        task = asyncio.create_task(goes_away())
        other = asyncio.create_task(play(batcher, "b", 2))
        await asyncio.sleep(0.05)
        if how == "cancel":
            assert not log.batches
            task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await other

    run(main())
    assert log.batches == [["b0"], ["b1"]]


def test_cancelled_request_is_not_run():
    log = Log()
    batcher = Batcher(log)

    async def main():
        batcher.enter("slow")
        waiting = asyncio.create_task(play(batcher, "a", 1))
        other = asyncio.create_task(play(batcher, "b", 1))
        await asyncio.sleep(0.01)
        waiting.cancel()
        await asyncio.sleep(0.01)
        batcher.leave("slow")
        await other

    run(main())
    assert log.batches == [["b0"]]


def test_failure_reaches_all_and_the_next_batch_runs():
    log = Log()
    batcher = Batcher(log)

    async def main():
        log.fail = True
        results = await asyncio.gather(*[play(batcher, n, 1) for n in "ab"], return_exceptions=True)
        assert [str(r) for r in results] == ["broken", "broken"]
        log.fail = False
        await play(batcher, "c", 1)

    run(main())
    assert log.batches == [["a0", "b0"], ["c0"]]


def test_episodes_that_wait_on_each_other_run_after_a_while():
    log = Log()
    batcher = Batcher(log, patience_s=0.05)

    async def main():
        done = asyncio.Event()

        async def follower():
            batcher.enter("follower")
            await done.wait()

        async def leader():
            await play(batcher, "leader", 1)
            done.set()

        await asyncio.gather(follower(), leader())

    run(main())
    assert log.batches == [["leader0"]]


def test_a_new_event_loop_starts_clean():
    log = Log()
    batcher = Batcher(log)

    async def abandoned():
        batcher.enter("ghost")
        task = asyncio.create_task(batcher.submit("other", 0, "never"))
        await asyncio.sleep(0)
        batcher.enter("other")
        task.cancel()

    run(abandoned())
    run(play(batcher, "a", 1))
    assert log.batches[-1] == ["a0"]


def test_a_second_loop_waits_for_every_episode_again() -> None:
    """The first episode that enters on a new event loop is as live as the others: one batch, not two."""
    batches: list[list[str]] = []
    batcher: Batcher[str] = Batcher(lambda jobs: batches.append(list(jobs)))

    async def episode(name: str, delay: float) -> None:
        batcher.enter(name)
        await asyncio.sleep(delay)
        await batcher.submit(name, 0, name)
        batcher.leave(name)

    async def play() -> None:
        await asyncio.gather(episode("a", 0.0), episode("b", 0.05))

    for _ in range(2):
        asyncio.run(play())
    assert batches == [["a", "b"], ["a", "b"]]
