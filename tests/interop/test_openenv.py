"""A world as an OpenEnv server: a client that knows nothing of this package plays it over HTTP on loopback."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request

import pytest

pytest.importorskip("openenv")
pytest.importorskip("minigrid")

SOLUTION = ("go forward", "go forward", "turn right", "go forward", "go forward")


@pytest.fixture(scope="module")
def server():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    options = ("level=MiniGrid-Empty-5x5-v0", "observation=compact", "action_mode=menu", "max_steps=10")
    command = [sys.executable, "-m", "agentspec.interop.openenv", "minigrid", "--port", str(port)]
    environment = os.environ | {"ENABLE_WEB_INTERFACE": "false"}
    process = subprocess.Popen([*command, *(w for o in options for w in ("--option", o))], env=environment)
    url = f"http://127.0.0.1:{port}"
    try:
        _wait(f"{url}/health", process)
        yield url
    finally:
        process.terminate()
        process.wait(30)


def _wait(url, process):
    for _ in range(1200):
        assert process.poll() is None, "the server ended by itself"
        try:
            urllib.request.urlopen(url, timeout=5).close()
            return
        except (urllib.error.URLError, OSError):
            time.sleep(0.1)
    raise AssertionError(f"nothing answers at {url}")


def test_a_foreign_client_solves_an_episode(server):
    from openenv import GenericEnvClient

    with GenericEnvClient(base_url=server) as client:
        first = client.reset(seed=3)
        assert "get to the green goal square" in first.observation["text"]
        assert "one action at a time" in first.observation["instruction"]
        assert first.observation["choices"][2] == "go forward" and not first.done
        wrong = client.step({"text": "fly"})
        assert "fly" in wrong.observation["error"] and wrong.reward == 0.0 and not wrong.done
        results = [client.step({"text": text}) for text in SOLUTION]
        assert [r.done for r in results] == [False] * 4 + [True]
        assert results[-1].reward == pytest.approx(1 - 0.9 * 6 / 10)  # the nonsense took a step
        state = client.state()
        assert (state["step_count"], state["seed"], state["metrics"]["success"]) == (6, 3, 1.0)


def test_sessions_do_not_share_an_episode(server):
    from openenv import GenericEnvClient

    with GenericEnvClient(base_url=server) as one, GenericEnvClient(base_url=server) as two:
        one.reset(seed=0)
        two.reset(split="test", index=4)
        one.step({"text": "turn right"})
        assert one.state()["step_count"] == 1 and two.state()["step_count"] == 0
        assert two.state()["seed"] == 20_004


def test_tasks_are_listed(server):
    with urllib.request.urlopen(f"{server}/minigrid/splits", timeout=30) as answer:
        assert b'"test"' in answer.read()


def test_an_unknown_task_is_refused():
    from agentspec.interop.openenv import World

    world = World("minigrid")
    with pytest.raises(ValueError, match="unknown split 'dev'; expected one of train"):
        world.reset(split="dev")
    with pytest.raises(IndexError, match="test has tasks 0 to 9999; got 10000"):
        world.get_task("test", 10_000)
    assert [t["seed"] for t in world.get_task_range("validation", 1, 3)] == [10_001, 10_002]
