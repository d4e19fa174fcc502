"""One run at a time writes into a folder, and what an earlier one left moves together."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from agentspec.records.folder import LOCK, checkpoints, hold, holds_run, last_complete_checkpoint, set_aside
from agentspec.registry import SpecError

HOLDER = """
import sys
from agentspec.records.folder import hold
with hold(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def elsewhere(tmp_path: Path) -> Any:
    """Another process that holds the folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout and process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()


def test_a_folder_in_use_is_refused_until_its_holder_is_gone(tmp_path: Path, elsewhere: Any) -> None:
    with (
        pytest.raises(SpecError, match=rf"under way \(process {elsewhere.pid} on .*another output_dir"),
        hold(tmp_path),
    ):
        pass
    elsewhere.kill()  # it cannot take its lock away
    elsewhere.wait()
    assert str(elsewhere.pid) in (tmp_path / LOCK).read_text()
    with hold(tmp_path):
        assert (tmp_path / LOCK).read_text().startswith(f"process {os.getpid()} on ")


def test_the_holder_may_hold_it_again_and_another_thread_may_not(tmp_path: Path) -> None:
    refused: list[str] = []

    def second() -> None:
        try:
            with hold(tmp_path):
                refused.append("")
        except SpecError as error:
            refused.append(str(error))

    with hold(tmp_path), hold(tmp_path):
        thread = threading.Thread(target=second)
        thread.start()
        thread.join()
        assert "under way" in refused[0]
    second()
    assert refused[1] == ""


def test_a_lock_that_was_left_behind_holds_nobody(tmp_path: Path) -> None:
    (tmp_path / LOCK).write_text("process 1 on another")
    with hold(tmp_path):
        assert f"process {os.getpid()} on " in (tmp_path / LOCK).read_text()
    assert (tmp_path / LOCK).read_text() == ""


# --- setting aside ---------------------------------------------------------------------------------------------------


def _run_in(folder: Path) -> set[str]:
    """What a run leaves, made of empty files."""
    names = {"manifest.json", "updates.jsonl", "metrics.jsonl", "seal.json", "adapter_model.safetensors", "notes.txt"}
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("{}")
    for name in (
        "trajectories/000000.jsonl",
        *(f"checkpoint-2/{n}" for n in ("scaffold_state.json", "trainer_state.json")),
    ):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("{}")
    return names | {"trajectories", "checkpoint-2"}


def test_everything_of_the_earlier_run_moves_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = _run_in(tmp_path)
    assert set_aside(tmp_path) == tmp_path / "earlier" / "1"
    assert {p.name for p in (tmp_path / "earlier" / "1").iterdir()} == names
    assert [p.name for p in tmp_path.iterdir()] == ["earlier"] and not holds_run(tmp_path)
    assert str(tmp_path / "earlier" / "1") in capsys.readouterr().err
    assert set_aside(tmp_path) is None
    assert set_aside(tmp_path / "nowhere") is None
    _run_in(tmp_path)
    assert set_aside(tmp_path) == tmp_path / "earlier" / "2"
    assert last_complete_checkpoint(tmp_path / "earlier" / "2") == tmp_path / "earlier" / "2" / "checkpoint-2"


def test_a_move_that_was_cut_short_goes_on_into_the_same_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = _run_in(tmp_path)
    rename, moved = Path.rename, []

    def interrupted(path: Path, target: Path) -> Path:
        if len(moved) == 3:
            raise KeyboardInterrupt
        moved.append(path.name)
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt):
        set_aside(tmp_path)
    assert moved[0] == "checkpoint-2"  # nothing that is left behind can be resumed from
    assert checkpoints(tmp_path) == []
    monkeypatch.setattr(Path, "rename", rename)
    assert set_aside(tmp_path) == tmp_path / "earlier" / "1"
    assert {p.name for p in (tmp_path / "earlier" / "1").iterdir()} == names
    assert [p.name for p in (tmp_path / "earlier").iterdir()] == ["1"]


def test_a_folder_without_a_run_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert set_aside(tmp_path) is None and (tmp_path / "notes.txt").is_file()


def test_own_output_stays(tmp_path: Path) -> None:
    """The log that a shell redirects a new run's output into does not move away with the earlier run."""
    _run_in(tmp_path)
    script = "import sys; from agentspec.records.folder import set_aside; set_aside(sys.argv[1]); print('after')"
    with open(tmp_path / "run.log", "w") as log:
        subprocess.run([sys.executable, "-c", script, str(tmp_path)], stdout=log, check=True)
    assert (tmp_path / "run.log").read_text() == "after\n"
    assert (tmp_path / "earlier" / "1" / "manifest.json").is_file()


def test_a_checkpoint_needs_its_last_file_and_its_trainer_state(tmp_path: Path) -> None:
    for number, names in ((2, ("scaffold_state.json",)), (10, ("trainer_state.json",)), (9, ("both",)), (3, ("both",))):
        folder = tmp_path / f"checkpoint-{number}"
        folder.mkdir()
        for name in ("scaffold_state.json", "trainer_state.json") if names == ("both",) else names:
            (folder / name).write_text("{}")
    (tmp_path / "checkpoint-final").mkdir()
    assert [p.name for p in checkpoints(tmp_path)] == ["checkpoint-3", "checkpoint-9"]  # by number, not as text
