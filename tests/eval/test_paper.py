"""The paper's numbers as data, and what is computed from them."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import pytest

from eval import paper

ROOT = Path(__file__).resolve().parents[2]


def test_every_number_of_the_file_is_read_and_known_ones_are_right() -> None:
    assert len(paper.numbers()) == 1410
    rl = paper.table("rl_combined", policy="grpo")
    assert rl["Qwen3-4B-Instruct", ("react", "base", "none")] == 5.62
    counts = [n.value for n in paper.numbers() if n.metric == "goal_conditions"]
    assert all(0 <= value <= 1 for value in counts) and 1 / 3 in counts  # `1/3` is a share
    with pytest.raises(ValueError, match="no table 'rl'; there are"):
        paper.table("rl")


def test_the_repeated_column_is_found() -> None:
    [(a, b, n)] = paper.printed_alike()
    assert {a[-10:], b[-9:]} == {"_qwen35_9b", "gpt5_mini"} and n == 12


def test_deviation_of_a_value_that_is_printed_twice() -> None:
    one = paper.numbers()[0]
    pairs = [(one, paper.Number(**{**one.__dict__, "value": one.value + d})) for d in (2.0, -2.0)]
    # d = 2, -2: mean of squares 4; each print has half of the variance of a difference: sqrt(4 / 2).
    assert paper.replication_deviation(pairs) == pytest.approx(math.sqrt(2))
    assert math.isnan(paper.replication_deviation([]))


def test_shares_of_an_additive_table() -> None:
    # Rows add 0 and 2, columns 0 and 4: nothing is left. Squares about the mean 3: rows 4 * 1, columns 4 * 4.
    shares = paper.additive_shares({("a", "x"): 0.0, ("a", "y"): 4.0, ("b", "x"): 2.0, ("b", "y"): 6.0})
    assert shares == pytest.approx({"rows": 0.2, "columns": 0.8, "rest": 0.0, "rest_deviation": 0.0})
    crossed = paper.additive_shares({("a", "x"): 1.0, ("a", "y"): 0.0, ("b", "x"): 0.0, ("b", "y"): 1.0})
    assert crossed == pytest.approx({"rows": 0.0, "columns": 0.0, "rest": 1.0, "rest_deviation": 1.0})


def test_agreement_is_one_for_equal_orders() -> None:
    scaffolds = [("a", "", ""), ("b", "", ""), ("c", "", "")]
    columns = [{s: float(i * k) for i, s in enumerate(scaffolds)} for k in (1, 2, 5)]
    w, _, ranks = paper.agreement(columns)
    assert w == pytest.approx(1.0) and ranks == {scaffolds[0]: 3.0, scaffolds[1]: 2.0, scaffolds[2]: 1.0}


def test_rates_that_no_count_gives() -> None:
    # Sevenths at one digit: 0, .1, .3, .4, .6, .7, .9, 1. Of the printed ones .2 and .5 are none.
    assert {n.value for n in paper.impossible_rates("alfred", 7)} == {0.2, 0.5}
    assert paper.impossible_rates("alfred", 7, 3) == [] == paper.impossible_rates("minigrid", 10)


def test_the_page_is_what_its_script_writes() -> None:
    spec = importlib.util.spec_from_file_location("update_paper_tables", ROOT / "docs" / "update_paper_tables.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.PAGE.read_text(encoding="utf-8") == module.page(), "run python docs/update_paper_tables.py"
