"""What differs between the versions of ai2thor that households need: starting, stepping, and what goes wrong.

ALFRED's trials were recorded with 2.1.0, RoboTHOR is played with 5.0.0. Both install a package called `ai2thor`, so an
environment holds one of them; each has an extra of its own. Neither package holds the simulator itself: a *build* is
downloaded on first use and needs an X display. `executable` names any other program that speaks the protocol.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from typing import Any, Protocol

from agentspec.envs.thor.engine import Settings
from agentspec.envs.thor.simulator.starting import (
    START_SECONDS,
    NoSimulator,
    alive,
    check_executable,
    controller_module,
    started,
    watch,
)


class Link(Protocol):
    """A Controller of one version."""

    def begin(self, scene: str) -> Any:
        """Start a scene from its beginning; ai2thor's event."""
        ...

    def step(self, action: dict[str, Any]) -> Any:
        """One action; ai2thor's event.

        Raises:
            ValueError: an action that the simulator does not know.
            NoSimulator: it has ended.
        """
        ...

    def stop(self) -> None:
        """End the simulator."""
        ...


class _Gone:
    """Stands for the event of a player that has ended."""

    metadata: Mapping[str, Any] = {"lastActionSuccess": True, "errorCode": ""}
    instance_detections2D = None  # noqa: N815  (ai2thor's name)


class AlfredLink:
    """ai2thor 2.1.0, as ALFRED starts it.

    Args:
        settings: picture size and distances.
        executable: a player instead of ai2thor's build; empty for that.
        pictures: whether the player renders.
        needs_display: whether to ask for an X display before starting.

    Raises:
        NoSimulator: it cannot be started.
    """

    version, extra = "2.1.0", "ai2thor-alfred"

    def __init__(self, settings: Settings, executable: str, pictures: bool, needs_display: bool = True) -> None:
        module = controller_module(self.version, self.extra)
        check_executable(executable)
        self._settings, self._pictures, self._stopping = settings, pictures, False
        self._controller = c = module.Controller(quality="MediumCloseFitShadows")
        c.local_executable_path = executable or None
        if not needs_display:
            c.check_x_display = lambda display: None
        self._gone, self._begun = _Gone(), 0.0
        watch(self._ended, lambda: None if self._stopping else c.request_queue.put(self._gone))
        size = {"player_screen_width": settings.width, "player_screen_height": settings.height}
        try:
            first = started(lambda: c.start(**size), self.version)
        except NoSimulator:
            self._stopping = True
            raise
        if first is self._gone:
            raise NoSimulator(f"the player {executable or 'of ai2thor ' + self.version} ended or did not answer")

    def _ended(self) -> bool:
        """Whether the player is gone, was stopped, or has not answered in time; a download may take any time."""
        c = self._controller
        if self._stopping or c.unity_pid is None:
            return self._stopping
        self._begun = self._begun or time.monotonic()
        late = c.last_event is None and time.monotonic() - self._begun > START_SECONDS
        return late or not alive(c.unity_pid)

    def begin(self, scene: str) -> Any:
        """Reset and initialize, with the fields ALFRED sends."""
        if self._controller.reset(scene) is self._gone:
            raise NoSimulator(f"the player of ai2thor {self.version} has ended")
        return self.step(
            {
                "action": "Initialize",
                "gridSize": self._settings.grid,
                "cameraY": 0.75,
                "visibilityDistance": self._settings.visibility,
                "renderImage": self._pictures,
                "renderDepthImage": False,
                "renderClassImage": False,
                "renderObjectImage": False,
                "makeAgentsVisible": False,
            }
        )

    def step(self, action: dict[str, Any]) -> Any:
        """One action; looks become teleports in place, for 2.1.0 looks by 30 degrees and ALFRED by 15."""
        name = action["action"]
        if name in ("LookUp", "LookDown"):
            at = self._controller.last_event.metadata["agent"]
            turn = self._settings.look_step * (1 if name == "LookDown" else -1)
            action = {"action": "TeleportFull", **at["position"], "rotation": at["rotation"]["y"]}
            action["horizon"] = round(at["cameraHorizon"] + turn, 3)
        elif name == "Stop":
            action = {"action": "Pass"}
        try:
            event = self._controller.step(action)
        except AssertionError as error:  # something lies in the queue already: the player ended between two steps
            raise NoSimulator(f"the player of ai2thor {self.version} has ended") from error
        if event is self._gone:
            raise NoSimulator(f"the player of ai2thor {self.version} has ended")
        return event

    def stop(self) -> None:
        """End the player."""
        if not self._stopping:
            self._stopping = True
            self._controller.stop()


class RoboThorLink:
    """ai2thor 5.0.0 with the LoCoBot; the Controller starts with the first scene.

    Args and errors: see `AlfredLink`.
    """

    version, extra = "5.0.0", "ai2thor-robothor"

    def __init__(self, settings: Settings, executable: str, pictures: bool, needs_display: bool = True) -> None:
        self._module = controller_module(self.version, self.extra)
        check_executable(executable)
        self._settings, self._executable, self._pictures = settings, executable, pictures
        self._controller: Any = None
        self._stopping = False

    def begin(self, scene: str) -> Any:
        """Start, or reset to the scene."""
        if self._controller is None:
            self._controller = started(lambda: self._start(scene), self.version)
            return self._controller.last_event
        return started(lambda: self._controller.reset(scene), self.version)

    def _start(self, scene: str) -> Any:
        s, link = self._settings, self

        class Watched(self._module.Controller):  # type: ignore[name-defined]
            """A Controller whose player is watched from its start on."""

            def _start_unity_thread(self, *args: Any) -> None:
                super()._start_unity_thread(*args)
                server = self.server
                watch(lambda: server.unity_proc.poll() is not None, lambda: link._wake(server))

        return Watched(
            scene=scene,
            local_executable_path=self._executable or None,
            x_display=os.environ.get("DISPLAY") or (":0" if self._executable else None),
            width=s.width,
            height=s.height,
            server_start_timeout=START_SECONDS,
            agentMode="locobot",
            gridSize=s.grid,
            rotateStepDegrees=s.rotate_step,
            visibilityDistance=s.visibility,
            fieldOfView=s.camera.field_of_view,
            snapToGrid=s.rotate_step % 90 == 0,
            applyActionNoise=False,
            renderImage=self._pictures,
        )

    def _wake(self, server: Any) -> None:
        """End the wait for a player that has ended: an empty message through its pipe."""
        for _ in range(round(START_SECONDS / 0.2)):
            if self._stopping:
                return
            try:
                pipe = os.open(server.server_pipe_path, os.O_WRONLY | os.O_NONBLOCK)
            except OSError:
                time.sleep(0.2)  # nobody has opened it to wait yet
                continue
            os.write(pipe, server.eom_header)
            os.close(pipe)
            return

    def step(self, action: dict[str, Any]) -> Any:
        """One action; a teleport gets the fields that 5.0.0 asks for."""
        name = action["action"]
        at = self._controller.last_event.metadata["agent"]
        if name == "Stop":
            action = {"action": "Done"}
        elif name == "TeleportFull":
            here = at["position"]
            action = {
                "action": name,
                "position": {k: action.get(k, here[k]) for k in "xyz"},
                "rotation": {"x": 0.0, "y": float(action.get("rotation", at["rotation"]["y"])), "z": 0.0},
                "horizon": action.get("horizon", at["cameraHorizon"]),
            }
        try:
            return self._controller.step(action)
        except (RuntimeError, OSError) as error:  # a timeout is an OSError
            raise NoSimulator(f"the player of ai2thor {self.version} has ended ({error})") from error

    def stop(self) -> None:
        """End the player."""
        if not self._stopping and self._controller is not None:
            self._stopping = True
            self._controller.stop()


LINKS: dict[str, type[AlfredLink] | type[RoboThorLink]] = {"2.1.0": AlfredLink, "5.0.0": RoboThorLink}
"""Version of ai2thor -> how to talk to it."""
