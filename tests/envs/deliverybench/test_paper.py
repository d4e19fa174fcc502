"""The paper's printed facts, and the settings that make figures comparable."""

from __future__ import annotations

import json
from pathlib import Path

from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from benchmarks import courier_menu, paper_facts
from tests.envs.deliverybench.helpers import REFERENCE, needs_reference

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "deliverybench.md"


def test_the_rules_have_the_printed_prices_and_speeds() -> None:
    assert [row.fact for row in paper_facts.rule_facts() if not row.agrees] == []
    assert len(paper_facts.rule_facts()) == 4


@needs_reference
def test_the_orders_have_the_printed_figures() -> None:
    rows = paper_facts.order_facts(REFERENCE / "maps")
    assert [(row.fact, row.printed, row.ours) for row in rows if not row.agrees] == []
    assert {row.seed for row in rows} == {"1", "4", "5", "11", "unseeded"} and len(rows) == 14


@needs_reference
def test_the_document_shows_them(tmp_path: Path, capsys) -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    rows = [*paper_facts.order_facts(REFERENCE / "maps"), *paper_facts.rule_facts()]
    assert paper_facts.written(text, rows) == text, "run python -m benchmarks.paper_facts --write docs/deliverybench.md"
    copy = tmp_path / "copy.md"
    copy.write_text("<!-- begin: paper facts -->\nold\n<!-- end: paper facts -->\n", encoding="utf-8")
    assert paper_facts.main(["--json", "--maps", str(REFERENCE / "maps"), "--write", str(copy)]) == 0
    assert all(row["agrees"] for row in json.loads(capsys.readouterr().out))
    assert "| order 0 | 5 | $11.29, 17 min | $11.29, 17 min |" in copy.read_text(encoding="utf-8")


def test_without_the_map_only_the_rules_are_compared(tmp_path: Path, capsys) -> None:
    assert paper_facts.main(["--maps", str(tmp_path)]) == 0
    assert "left out" in capsys.readouterr().out


@needs_reference
def test_order_seeds_reach_the_environment(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("AGENTSPEC_CACHE", str(tmp_path))
    city = REFERENCE / "maps" / paper_facts.CITY
    env = DeliveryBenchEnv(map=city, rules="original", order_seed=5)
    offers = env.reset(seed=99)[1]["state"]["offers"]
    assert (offers[0]["pay"], offers[0]["distance_m"]) == (11.29, 1389)
    unseeded = DeliveryBenchEnv(map=city, rules="original", order_seed="original")
    assert unseeded.reset(seed=99)[1]["state"]["offers"][7]["pickup"] == "restaurant 4"


def test_the_menu_benchmark_has_its_figures(monkeypatch, capsys) -> None:
    monkeypatch.setattr(courier_menu, "MENU", {**courier_menu.MENU, "shift_hours": 0.2})
    monkeypatch.setattr(courier_menu, "shift", lambda seed, options: REAL(seed, {"shift_hours": 0.2, **options}))
    assert courier_menu.main(["--json", "--sizes", "tiny", "--cities", "1", "--seeds", "1"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["kept"] >= courier_menu.GOAL and row["menu_choices"] <= 12 and row["menu_steps"] >= row["native_steps"]
    assert "tiny" in courier_menu.table([row])


REAL = courier_menu.shift
