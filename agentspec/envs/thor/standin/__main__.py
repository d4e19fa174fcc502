"""`python -m agentspec.envs.thor.standin`: started by ai2thor's Controller, with its arguments and variables."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from agentspec.envs.thor.standin.launch import FOLDERS
from agentspec.envs.thor.standin.play import Scenes, StandIn
from agentspec.envs.thor.standin.wires import Pipes, Posts, Wire


def connect() -> Wire:
    """The way to the Controller that started this program, as its variables say.

    Raises:
        SystemExit: no Controller started it.
    """
    given = os.environ
    if given.get("AI2THOR_SERVER_TYPE") == "FIFO":
        return Pipes(given["AI2THOR_FIFO_SERVER_PIPE_PATH"], given["AI2THOR_FIFO_CLIENT_PIPE_PATH"])
    if "AI2THOR_PORT" in given:
        return Posts(given.get("AI2THOR_HOST", "127.0.0.1"), int(given["AI2THOR_PORT"]), given["AI2THOR_CLIENT_TOKEN"])
    raise SystemExit("this program is started by ai2thor's Controller, with local_executable_path=<a file that does>")


def main(arguments: Sequence[str]) -> None:
    """Play until nobody asks any more."""
    parser = argparse.ArgumentParser(prog="agentspec.envs.thor.standin", description=__doc__, allow_abbrev=False)
    for name in FOLDERS:
        parser.add_argument(f"--{name}", default="")
    parser.add_argument("-screen-width", type=int, default=300)
    parser.add_argument("-screen-height", type=int, default=300)
    given, _ = parser.parse_known_args(arguments)
    player = StandIn(
        Scenes(**{name: getattr(given, name) for name in FOLDERS}), (given.screen_width, given.screen_height)
    )
    wire = connect()
    action: dict[str, object] | None = {}
    while action is not None:
        metadata, picture = player.answer(action)
        envelope = {
            "agents": [metadata],
            "thirdPartyCameras": [],
            "activeAgentId": 0,
            "sequenceId": action.get("sequenceId", 0),
        }
        action = wire.exchange(envelope, picture)


if __name__ == "__main__":
    main(sys.argv[1:])
