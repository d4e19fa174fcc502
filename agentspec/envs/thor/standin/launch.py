"""An executable file that starts the stand-in, for ai2thor's `local_executable_path`."""

from __future__ import annotations

import shlex
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FOLDERS = ("trials", "objects", "layouts", "episodes")
"""What the stand-in can be told: where ALFRED's json files, recorded objects, layouts and episode files are."""


@dataclass(frozen=True)
class Script:
    """The file; `remove` it when it is not needed any more."""

    path: str
    folder: Any

    def remove(self) -> None:
        """Delete the file."""
        self.folder.cleanup()


def write_executable(folders: Mapping[str, str]) -> Script:
    """Write the file into a temporary folder.

    Args:
        folders: see `FOLDERS`; without any the stand-in has the package's own scenes only.
    """
    root = Path(__file__).resolve().parents[4]
    call = [sys.executable, "-m", "agentspec.envs.thor.standin"]
    for name in FOLDERS:
        if folders.get(name):
            call += [f"--{name}", str(Path(folders[name]).resolve())]
    folder = tempfile.TemporaryDirectory(prefix="agentspec-standin-")
    path = Path(folder.name) / "player"
    path.write_text(
        f'#!/bin/sh\nexport PYTHONPATH={shlex.quote(str(root))}"${{PYTHONPATH:+:$PYTHONPATH}}"\n'
        f'exec {shlex.join(call)} "$@"\n',
        encoding="utf-8",
    )
    path.chmod(0o755)
    return Script(str(path), folder)
