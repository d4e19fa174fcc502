"""The disk cache: used, versioned by content, safe against damage and against other processes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from agentspec.envs.deliverybench.city import cache, citymap
from agentspec.envs.deliverybench.city.citymap import City, load_city
from agentspec.envs.deliverybench.city.generate import write_city


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AGENTSPEC_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(citymap, "_memory", {})
    return write_city(tmp_path / "town", "tiny", 2)


def fresh(folder: Path) -> City:
    """Load as a new process would: nothing in memory."""
    citymap._memory.clear()
    return load_city(folder)


def files() -> list[Path]:
    return sorted((cache.cache_dir() / "deliverybench").iterdir())


def same(a: City, b: City) -> bool:
    walks = [[c.walk_route(p.anchor, c.pois[0].anchor) for p in c.pois] for c in (a, b)]
    drives = [[c.car_route(p.anchor, c.pois[0].anchor) for p in c.pois] for c in (a, b)]
    return (
        a.pois == b.pois and a.walk == b.walk and a.drive == b.drive and walks[0] == walks[1] and drives[0] == drives[1]
    )


def test_second_load_reads_the_file_and_is_equal(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = fresh(folder)
    assert load_city(folder) is first
    assert len(files()) == 1
    monkeypatch.setattr(citymap, "compile_walk", None)  # compiling again would fail
    assert same(fresh(folder), first)


@pytest.mark.parametrize("damage", ["empty", "cut", "text", "bits"])
def test_a_damaged_file_is_rebuilt(folder: Path, damage: str) -> None:
    first = fresh(folder)
    (file,) = files()
    good = file.read_bytes()
    middle = len(good) // 2
    bad = {
        "empty": b"",
        "cut": good[:middle],
        "text": b"not a city",
        "bits": good[:middle] + bytes(b ^ 255 for b in good[middle : middle + 64]) + good[middle + 64 :],
    }[damage]
    file.write_bytes(bad)
    assert same(fresh(folder), first)
    assert files() == [file] and file.read_bytes() == good


def test_a_changed_map_is_another_city(folder: Path) -> None:
    first = fresh(folder)
    write_city(folder, "tiny", 3)
    second = load_city(folder)
    assert second.pois != first.pois and len(files()) == 2


def test_an_unwritable_cache_is_no_obstacle(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("AGENTSPEC_CACHE", str(tmp_path / "file"))
    assert fresh(folder).pois


def test_cache_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("AGENTSPEC_CACHE", str(tmp_path))
    assert cache.cache_dir() == tmp_path
    monkeypatch.delenv("AGENTSPEC_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setattr(sys, "platform", "linux")
    assert cache.cache_dir() == tmp_path / "xdg" / "agentspec"


def test_many_processes_at_once(folder: Path) -> None:
    module = "agentspec.envs.deliverybench.city.citymap"
    code = f"from {module} import load_city; print(len(load_city({str(folder)!r}).pois))"
    running = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) for _ in range(3)]
    answers = {process.communicate(timeout=120)[0].strip() for process in running}
    assert answers == {str(len(fresh(folder).pois))}
    assert len(files()) == 1  # no temporary file is left
