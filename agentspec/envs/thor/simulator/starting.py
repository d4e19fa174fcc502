"""Starting the simulator, and what goes wrong then and later, told in one line."""

from __future__ import annotations

import importlib
import os
import threading
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import Any

START_SECONDS = 60.0
"""Seconds within which a started player must answer."""


class NoSimulator(RuntimeError):  # noqa: N818  (reads as a sentence)
    """The simulator cannot be started, or has ended; the message is one line and says what to do."""


def controller_module(wanted: str, extra: str) -> Any:
    """`ai2thor.controller` of one version.

    Raises:
        NoSimulator: it is not installed, or in another version.
    """
    try:
        found = version("ai2thor")
        module = importlib.import_module("ai2thor.controller")
    except (PackageNotFoundError, ImportError) as error:
        raise NoSimulator(
            f"the player ai2thor needs the package ai2thor {wanted}: pip install 'agentspec-rl[{extra}]' ({error})"
        ) from error
    if found != wanted:
        raise NoSimulator(
            f"ai2thor {found} is installed, this world needs {wanted}: the two exclude each other, make another "
            f"environment and pip install 'agentspec-rl[{extra}]' there"
        )
    return module


def check_executable(path: str) -> None:
    """Refuse a path that cannot be started.

    Raises:
        NoSimulator: it cannot.
    """
    if path and not os.access(path, os.X_OK):
        raise NoSimulator(f"there is no executable file {path}; expected a player that speaks ai2thor's protocol")


def started(make: Callable[[], Any], wanted: str) -> Any:
    """What `make` returns, with ai2thor's several ways to fail told in one line.

    Raises:
        NoSimulator: no display, no build, no network, or a player that ends or never answers.
    """
    where = f"ai2thor {wanted}"
    own = "or name a player with executable="
    try:
        return make()
    except NoSimulator:
        raise
    except Exception as error:
        told = " ".join(str(error).split())[:200]
        if "display" in told.lower() or "missing dependencies" in told.lower():
            message = f"{where} needs an X display with GLX and found none; set DISPLAY, {own} ({told})"
        elif isinstance(error, OSError) and type(error).__module__.startswith("requests"):
            message = f"no build of {where} is here and none can be downloaded: no network; install one, {own} ({told})"
        elif "no build exists" in told.lower():
            message = f"no build of {where} is here and none can be downloaded (no network?); install one, {own}"
        else:
            message = f"{where} did not start: {type(error).__name__}: {told}"
        raise NoSimulator(message) from error


def watch(ended: Callable[[], bool], wake: Callable[[], None]) -> None:
    """In the background: call `wake` once when the player has ended, for nobody else wakes who waits for it."""

    def look() -> None:
        while not ended():
            time.sleep(0.2)
        wake()

    threading.Thread(target=look, daemon=True).start()


def alive(pid: int) -> bool:
    """Whether there is a process of this number."""
    try:
        os.kill(pid, 0)
    except OSError:
        return False
    return True
