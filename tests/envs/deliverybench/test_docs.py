"""The document about the environment: generated parts are up to date, and every argument is described."""

from __future__ import annotations

import inspect
import json
from pathlib import Path

import pytest

from agentspec.envs.deliverybench.city.generate import SPLITS, write_city
from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.world.rules import FAIR, ORIGINAL, quirk_table
from benchmarks import city_statistics, deliverybench

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "deliverybench.md"


def test_rules_are_up_to_date() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    assert city_statistics.fill(text, "rules", quirk_table()) == text, (
        "docs/deliverybench.md does not show the present rules: run python -m benchmarks.city_statistics --write"
    )
    assert f"after {ORIGINAL.max_calls} actions" in text and f"open orders to {FAIR.max_active_orders}" in text


def test_statistics_have_a_row_for_every_size() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    for size in city_statistics.SIZES:
        assert text.count(f"| {size}, generated") == 2  # the cities, and the couriers


def test_every_argument_and_split_is_described() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    for name in inspect.signature(DeliveryBenchEnv).parameters:
        assert f"`{name}`" in text
    assert ", ".join(f"{name} {s.start}-{s.stop - 1}" for name, s in SPLITS.items()) in text
    assert (DOCUMENT.parent / "images" / "deliverybench.png").is_file()


def test_fill_needs_its_markers() -> None:
    document = "a\n<!-- begin: x -->\nold\n<!-- end: x -->\nb"
    assert city_statistics.fill(document, "x", "new") == "a\n<!-- begin: x -->\n\nnew\n\n<!-- end: x -->\nb"
    with pytest.raises(ValueError, match="no section 'y'"):
        city_statistics.fill(document, "y", "new")


def test_statistics_of_a_city() -> None:
    (title, members), *_ = city_statistics.cities(1)
    row = city_statistics.row(title, [(members[0][0], {**members[0][1], "shift_hours": 0.25})], seeds=2)
    assert row["way_p10"] <= row["way"] <= row["way_p90"] and row["rule_based"] > row["random"]
    assert len(city_statistics.table([row]).splitlines()) == 7  # two tables of three lines, and an empty one


def test_speed_benchmark_generates_a_city_where_no_map_is(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(deliverybench, "REFERENCE_MAPS", tmp_path / "none")
    folder, name = deliverybench.city_folder(None, tmp_path)
    assert (folder / "roads.json").is_file() and "generated" in name


def test_speed_benchmark_has_its_figures(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(deliverybench, "STEPS", 200)
    monkeypatch.setattr(deliverybench, "ENVIRONMENTS", 4)
    folder = write_city(tmp_path / "tiny-0", "tiny", 0)
    deliverybench.main(["--json", "--map", str(folder), "--shifts", "1", "--repeats", "1"])
    result = json.loads(capsys.readouterr().out)
    for key in ("steps_per_s", "steps_per_s_full_text", "warm_reset_ms", "snapshot_ms", "restore_ms", "env_bytes"):
        assert result[key] > 0.0
    assert list(result["envs_in_one_process"]) == ["1", "16", "64"]
    assert "published speed of the original" in deliverybench.table(result)
