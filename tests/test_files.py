"""Files: whole or absent, and JSON lines that survive an append that was cut short."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from agentspec import files


def test_a_line_that_was_cut_short_is_passed_over_and_then_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "a" / "log.jsonl"
    files.append_lines(path, {"b": 1, "a": "ä"}, {"c": (2, np.float64(0.5))})
    assert path.read_text(encoding="utf-8") == '{"a": "ä", "b": 1}\n{"c": [2, 0.5]}\n'
    with open(path, "a", encoding="utf-8") as file:
        file.write('{"half')
    before = path.read_bytes()
    assert files.read_lines(path) == [{"a": "ä", "b": 1}, {"c": [2, 0.5]}]
    assert files.last_line(path) == b'{"c": [2, 0.5]}\n'
    assert path.read_bytes() == before  # reading changes nothing
    files.append_lines(path, {"d": 3})
    assert files.read_lines(path)[2:] == [{"d": 3}]


@pytest.mark.parametrize("content", [b"", b"no newline at all", b"x" * 200_000])
def test_a_file_without_a_whole_line_holds_nothing(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "log.jsonl"
    path.write_bytes(content)
    assert files.read_lines(path) == [] and files.last_line(path) == b""
    files.repair_lines(path)
    assert path.read_bytes() == b""


def test_lines_longer_than_what_is_read_at_once(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    files.write_lines(path, [{"first": 1}, {"long": "y" * 150_000}])
    with open(path, "ab") as file:
        file.write(b"z" * 70_000)
    assert len(files.last_line(path)) == len('{"long": ""}\n') + 150_000
    files.repair_lines(path)
    assert [list(r) for r in files.read_lines(path)] == [["first"], ["long"]]


def test_what_is_missing_has_no_lines(tmp_path: Path) -> None:
    files.repair_lines(tmp_path / "none")
    assert files.read_lines(tmp_path / "none") == [] and files.last_line(tmp_path / "none") == b""


def test_damage_is_named_by_file_and_line(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    path.write_text('{"a": 1}\n\n{broken\n')
    with pytest.raises(ValueError, match=r"log\.jsonl, line 3: not JSON"):
        files.read_lines(path)
    path.write_text("[1]\n")
    with pytest.raises(ValueError, match=r"line 1: expected a JSON object, got list"):
        files.read_lines(path)


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "f"
    files.write_atomic(path, "old")
    monkeypatch.setattr(files.os, "replace", lambda *_: (_ for _ in ()).throw(OSError("full")))
    with pytest.raises(OSError, match="full"):
        files.write_atomic(path, "new")
    assert path.read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["f"]


def test_digests(tmp_path: Path) -> None:
    (tmp_path / "f").write_bytes(b"abc")
    assert files.file_digest(tmp_path / "f") == files.digest("abc") == hashlib.sha256(b"abc").hexdigest()
