"""The simulator as a player: ai2thor's own Controllers over the stand-in, and what goes wrong without them.

The tests that need ai2thor 2.1.0 (ALFRED) or 5.0.0 (RoboTHOR) skip where another version or none is installed.
"""

from __future__ import annotations

import json
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pytest

from agentspec.envs import check_environment
from agentspec.envs.alfred.env import AlfredEnv
from agentspec.envs.alfred.expert import Expert
from agentspec.envs.alfred.goals import Changes, progress
from agentspec.envs.alfred.staging import SETTINGS, set_up
from agentspec.envs.alfred.trials import read_trial, trial_path
from agentspec.envs.robothor.env import RoboThorEnv
from agentspec.envs.robothor.expert import Oracle
from agentspec.envs.robothor.presets import PRESETS
from agentspec.envs.thor.engine import OfflineThor
from agentspec.envs.thor.homes import apartment
from agentspec.envs.thor.simulator import starting
from agentspec.envs.thor.simulator.links import AlfredLink, RoboThorLink
from agentspec.envs.thor.simulator.mirror import complete, mirror
from agentspec.envs.thor.simulator.player import Ai2Thor
from agentspec.envs.thor.simulator.starting import NoSimulator
from agentspec.envs.thor.standin.launch import write_executable
from agentspec.envs.thor.standin.play import Scenes, StandIn
from agentspec.envs.thor.standin.wires import Posts
from agentspec.types import Task
from tests.envs.alfred.test_replays import ALL, CONTROLS
from tests.envs.thor.household import EPISODES, LAYOUTS, OBJECTS, TRIALS, needs_data

try:
    INSTALLED = version("ai2thor")
except PackageNotFoundError:
    INSTALLED = ""

needs_210 = pytest.mark.skipif(
    INSTALLED != "2.1.0", reason=f"ai2thor 2.1.0 is not installed (got {INSTALLED or 'none'})"
)
needs_500 = pytest.mark.skipif(
    INSTALLED != "5.0.0", reason=f"ai2thor 5.0.0 is not installed (got {INSTALLED or 'none'})"
)

STANDIN = {"player": "ai2thor", "executable": "standin"}
VAL = {"suite": "validation", "data": EPISODES, "objects": OBJECTS}


# -- 2.1.0 -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def alfred_player():
    folders = {"trials": TRIALS, "objects": OBJECTS, "layouts": LAYOUTS}
    player = Ai2Thor("2.1.0", SETTINGS, executable="standin", pictures=False, folders=folders)
    yield player
    player.close()


def replay(player, task: int, number: int, leave_out=lambda action: False):
    """Goal progress after a recorded plan, and the actions that failed."""
    one = read_trial(trial_path(Path(TRIALS), task, number))
    player.begin(one.scene)
    set_up(player, one)
    changes, failed, event = Changes(), [], player.observe()
    for action in one.plan:
        if not leave_out(action):
            event = player.step(action)
            changes.follow(event.metadata, str(action.get("objectId", "")))
            failed += [] if event.success else [(action, event.error)]
    return progress(one.type, one.targets, event.metadata, changes), failed


@needs_210
@needs_data
def test_recorded_experts_meet_all_51_goal_conditions_through_ai2thors_controller(alfred_player):
    reached = [replay(alfred_player, task, number) for task, number in ALL]
    assert [failed for _, failed in reached] == [[]] * 21
    assert all(r.success for r, _ in reached)
    assert (sum(r.met for r, _ in reached), sum(r.total for r, _ in reached)) == (51, 51)


@needs_210
@needs_data
@pytest.mark.parametrize(("task", "leave_out", "met"), CONTROLS)
def test_without_the_step_that_matters_ai2thor_does_not_reach_the_goal(alfred_player, task, leave_out, met):
    reached, _ = replay(alfred_player, task, 0, leave_out)
    assert not reached.success and reached.met == met


def same_play(make, player, options, seed: int, steps: int = 200) -> dict:
    """Plays with a simulator and offline at once; all that an agent gets must be the same."""
    env, twin = make(**options, **STANDIN, images=True), make(**options, images=True)
    try:
        (seen, info), (expected, _) = env.reset(seed=seed), twin.reset(seed=seed)
        ended = False
        for _ in range(steps):
            assert seen["text"] == expected["text"]
            assert np.array_equal(seen["image"], expected["image"])
            if ended:
                break
            text = player.act(info)
            seen, reward, terminated, truncated, info = env.step(text)
            expected, paid, *theirs, _ = twin.step(text)
            assert reward == pytest.approx(paid) and [terminated, truncated] == theirs
            ended = terminated or truncated
        return info
    finally:
        env.close()


@needs_210
@pytest.mark.parametrize(("seed", "mode"), [(2, "native"), (7, "menu"), (13, "native")])
def test_alfred_through_ai2thor_is_what_it_is_offline(seed, mode):
    options = {"action_mode": mode}
    assert same_play(AlfredEnv, Expert(options), options, seed)["success"]


@needs_210
def test_the_contract_holds_through_ai2thor():
    check_environment(Task("alfred", 0, {**STANDIN, "max_steps": 6}))


@needs_210
def test_a_player_that_ends_is_told(tmp_path):
    script = tmp_path / "player"
    script.write_text("#!/bin/sh\nexit 3\n", encoding="utf-8")
    script.chmod(0o755)
    with pytest.raises(NoSimulator, match="ended"):
        AlfredLink(SETTINGS, str(script), False, needs_display=False)


@needs_210
def test_a_player_that_ends_on_the_way_is_told():
    player = Ai2Thor("2.1.0", SETTINGS, executable="standin", pictures=False)
    player.begin("Kitchen1")
    player._link._controller.stop_unity()
    with pytest.raises(NoSimulator, match="has ended"):
        for _ in range(20):
            player.step({"action": "MoveAhead"})
    player.close()


# -- 5.0.0 -------------------------------------------------------------------------------------------------------------


@needs_500
@needs_data
def test_the_oracle_finds_all_ten_through_ai2thors_pipes():
    env, spl = RoboThorEnv(**VAL, **STANDIN), []
    player = Oracle({**VAL, **STANDIN})
    for seed in range(10):
        _, info = env.reset(seed=seed)
        ended = False
        while not ended:
            *_, terminated, truncated, info = env.step(player.act(info))
            ended = terminated or truncated
        assert info["success"]
        spl.append(info["metrics"]["spl"])
        env.reset(seed=seed)
        *_, info = env.step("STOP()")
        assert info["metrics"]["success"] == info["metrics"]["spl"] == 0.0
    env.close()
    assert np.mean(spl) == pytest.approx(0.953, abs=0.005)


@needs_500
@pytest.mark.parametrize("preset", ["paper", "casestudy"])
def test_robothor_through_ai2thor_is_what_it_is_offline(preset):
    options = {"preset": preset, "reward": "progress"}
    assert same_play(RoboThorEnv, Oracle(options), options, 4)["success"]


@needs_500
def test_a_larger_picture_arrives_whole():
    env = RoboThorEnv(preset="challenge2021", images=True, **STANDIN)
    seen, _ = env.reset(seed=1)
    env.close()
    assert seen["image"].shape == (480, 640, 3) and seen["image"].std() > 10


@needs_500
def test_the_contract_holds_through_pipes():
    check_environment(Task("robothor", 1, {**STANDIN, "max_steps": 6}), seed=1)


@needs_500
def test_the_stand_in_speaks_http_to_version_5():
    from ai2thor.controller import Controller
    from ai2thor.wsgi_server import WsgiServer

    script = write_executable({})
    controller = Controller(
        scene="Apartment1", local_executable_path=script.path, server_class=WsgiServer, x_display=":0", gridSize=0.25
    )
    try:
        event = controller.step(action="RotateRight")
        assert event.metadata["lastActionSuccess"] and event.metadata["agent"]["rotation"]["y"] == 90.0
        assert event.frame.shape == (300, 300, 3)
        with pytest.raises(ValueError, match="no action"):
            controller.step(action="Fly")
    finally:
        controller.stop()
        script.remove()


@needs_500
def test_an_action_that_ai2thor_raises_for_is_a_failure():
    player = Ai2Thor("5.0.0", PRESETS["paper"].settings, executable="standin", pictures=False)
    player.begin("Apartment1")
    event = player.step({"action": "Fly"})
    assert not event.success and "Fly" in event.error
    assert player.step({"action": "RotateLeft"}).success
    player.close()


@needs_500
def test_a_player_that_ends_is_told_by_pipes(tmp_path):
    script = tmp_path / "player"
    script.write_text("#!/bin/sh\nexit 3\n", encoding="utf-8")
    script.chmod(0o755)
    link = RoboThorLink(PRESETS["paper"].settings, str(script), False, needs_display=False)
    with pytest.raises(NoSimulator, match="did not start"):
        link.begin("Apartment1")


# -- without ai2thor ---------------------------------------------------------------------------------------------------


@pytest.mark.skipif(INSTALLED != "", reason="ai2thor is installed")
@pytest.mark.parametrize(("name", "extra"), [("alfred", "ai2thor-alfred"), ("robothor", "ai2thor-robothor")])
def test_a_missing_package_names_its_extra(name, extra):
    env = (AlfredEnv if name == "alfred" else RoboThorEnv)(player="ai2thor")
    with pytest.raises(NoSimulator, match=extra):
        env.reset(seed=0)


def test_the_other_version_is_refused(monkeypatch):
    monkeypatch.setattr(starting, "version", lambda package: "2.7.2")
    monkeypatch.setattr(starting.importlib, "import_module", lambda name: sys)
    with pytest.raises(NoSimulator, match=r"2\.7\.2 is installed, this world needs 2\.1\.0.*ai2thor-alfred"):
        starting.controller_module("2.1.0", "ai2thor-alfred")


class NoConnectionError(OSError):
    """As the module `requests` raises one."""


NoConnectionError.__module__ = "requests.exceptions"


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (AssertionError("Invalid DISPLAY :0.0 - cannot find X server with xdpyinfo"), "needs an X display"),
        (Exception("The following builds were found, but had missing dependencies."), "needs an X display"),
        (NoConnectionError("Failed to resolve 's3-us-west-2.amazonaws.com'"), "no network"),
        (ValueError("Invalid commit_id: f08 - no build exists for arch=Linux platforms=Linux64"), "no build"),
        (RuntimeError("something\nelse"), "did not start: RuntimeError: something else"),
    ],
)
def test_what_goes_wrong_is_told_in_one_line(error, told):
    def fails():
        raise error

    with pytest.raises(NoSimulator, match=told) as caught:
        starting.started(fails, "5.0.0")
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(INSTALLED not in ("2.1.0", "5.0.0"), reason="ai2thor is not installed")
def test_an_executable_that_is_not_there_is_refused():
    make = AlfredLink if INSTALLED == "2.1.0" else RoboThorLink
    with pytest.raises(NoSimulator, match="no executable file"):
        make(SETTINGS, "/nowhere/player", False)


def test_an_executable_needs_the_player_that_starts_it():
    with pytest.raises(ValueError, match="player='ai2thor'"):
        AlfredEnv(executable="standin")


def test_the_stand_in_answers_as_its_settings_say():
    player = StandIn(Scenes(), (320, 300))
    first, picture = player.answer({})
    assert first["screenWidth"] == 320 and len(picture) == 320 * 300 * 3
    assert "Kitchen1" in player.answer({"action": "GetScenesInBuild"})[0]["actionReturn"]
    assert player.answer({"action": "Reset", "sceneName": "Kitchen1_physics"})[0]["sceneName"] == "Kitchen1"
    told, _ = player.answer({"action": "Initialize", "rotateStepDegrees": 30, "renderImage": False})
    assert told["lastActionSuccess"]
    before = told["agent"]["rotation"]["y"]
    told, picture = player.answer({"action": "RotateRight"})
    assert told["agent"]["rotation"]["y"] == before + 30 and picture is None
    assert player.answer({"action": "Fly"})[0]["errorCode"] == "InvalidAction"
    failed, _ = player.answer({"action": "Reset", "sceneName": "Nowhere"})
    assert not failed["lastActionSuccess"] and "Nowhere" in failed["errorMessage"]
    json.dumps(failed)


def test_posts_are_forms_with_the_picture_as_it_is():
    """Read back with the standard library's own parser, by a server that answers with two actions and an end."""
    got, answers = [], [{"action": "Pass", "sequenceId": 1}, {}]

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self):
            got.append((self.headers["Content-Type"], self.rfile.read(int(self.headers["Content-Length"]))))
            body = json.dumps(answers[len(got) - 1]).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *args):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    wire, picture = Posts("127.0.0.1", server.server_port, "secret"), bytes(range(256))
    assert wire.exchange({"sequenceId": 0}, picture) == answers[0]
    assert wire.exchange({"sequenceId": 1}, None) is None
    server.shutdown()
    kind, body = got[0]
    boundary = kind.partition("boundary=")[2].encode()
    parts = [p.strip(b"\r\n").partition(b"\r\n\r\n") for p in body.split(b"--" + boundary)[1:-1]]
    assert [p[2] for p in parts[:2]] == [b'{"sequenceId": 0}', b"secret"]
    assert picture in body and b'name="image"' in parts[2][0]


def test_boxes_are_made_from_metadata():
    world = OfflineThor(apartment())
    world.step({"action": "TeleportFull", "x": 2.0, "z": 1.5, "rotation": 180, "horizon": 30})
    metadata = world.observe().metadata
    twin = mirror(complete(metadata), apartment().cells, world.settings)
    assert [o["objectId"] for o in twin.observe().metadata["objects"]] == [o["objectId"] for o in metadata["objects"]]
    assert twin.observe().metadata["agent"] == metadata["agent"]


def test_metadata_of_builds_without_boxes_get_usual_sizes():
    apple = {"objectId": "Apple|1", "objectType": "Apple", "visible": True, "position": {"x": 1.0, "y": 0.5, "z": 2.0}}
    told = complete({"objects": [apple | {"receptacleObjectIds": None}], "inventoryObjects": [{"objectId": "Apple|1"}]})
    one = told["objects"][0]
    assert one["isPickedUp"] and one["receptacleObjectIds"] == [] and not one["openable"]
    assert one["axisAlignedBoundingBox"]["center"] == {"x": 1.0, "y": 0.545, "z": 2.0}
