"""Logs for Inspect's viewer: `agentspec export --to inspect SOURCE` writes them, `agentspec view DIR` opens them."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

from agentspec.registry import SpecError

INSPECT = "inspect"
SUFFIX = ".eval"
NEEDED = "Inspect's viewer is not installed: pip install 'agentspec-rl[inspect]'"


def export_logs(arguments: argparse.Namespace) -> int:
    """Write logs of an evaluation, a training run or a file of trajectories."""
    from eval.inspect_logs import export_inspect

    source = Path(arguments.run)
    folder = Path(arguments.out) if arguments.out else (source if source.is_dir() else source.parent) / INSPECT
    written = export_inspect(source, folder, pictures=arguments.pictures)
    print(f"{len(written)} logs in {folder}; open them with: agentspec view {folder}")
    return 0


def holds_logs(folder: str) -> bool:
    """Whether a folder has logs in it."""
    return Path(folder).is_dir() and any(Path(folder).glob(f"*{SUFFIX}"))


def view_logs(folder: str, bundle: str = "") -> int:
    """Serve a folder of logs in the browser until stopped, or write it as a static site.

    Raises:
        SpecError: Inspect is not installed, or the folder of the site exists already.
    """
    if bundle:
        try:
            from inspect_ai.log import bundle_log_dir
        except ImportError:
            raise SpecError(NEEDED) from None
        if Path(bundle).exists():
            raise SpecError(f"{bundle} exists; give a new folder for the site")
        bundle_log_dir(folder, bundle)
        print(f"{bundle}/index.html; serve it with: {Path(sys.executable).name} -m http.server -d {bundle}")
        return 0
    program = shutil.which(INSPECT, path=str(Path(sys.executable).parent)) or shutil.which(INSPECT)
    if program is None:
        raise SpecError(NEEDED)
    return subprocess.run([program, "view", "start", "--log-dir", folder], check=False).returncode
