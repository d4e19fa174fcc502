"""The table of what memories cost: figures of an episode, the paper's ratios, and where ours differ."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from agentspec.llm.scripted import ScriptedLLM
from benchmarks.memory_cost import PAPER, markdown, paper_ratios, played

PAPER_ROWS = (
    ("t1", "big", "base", "input_tokens_per_step", "100"),
    ("t1", "big", "amem", "input_tokens_per_step", "200"),
    ("t2", "small", "base", "input_tokens_per_step", "10"),
    ("t2", "small", "amem", "input_tokens_per_step", "40"),
    ("t2", "small", "amem", "output_tokens_per_step", "5"),  # no base to compare with
)


def csv(folder: Path) -> Path:
    head = "table,environment,backbone,reasoning,memory,reflection,policy,metric,value,note"
    rows = [f"{t},deliverybench,{b},react,{m},none,non_rl,{k},{v}," for t, b, m, k, v in PAPER_ROWS]
    rows.append("t1,deliverybench,big,react,amem,reflexion,non_rl,input_tokens_per_step,9000,")
    rows.append("t1,minigrid,big,react,amem,none,non_rl,input_tokens_per_step,9000,")
    path = folder / "results.csv"
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def test_ratios_are_within_a_table_and_a_backbone(tmp_path: Path) -> None:
    # 200 / 100 and 40 / 10; with a reflector or in another world it is another agent.
    assert paper_ratios(csv(tmp_path)) == {"amem": {"input_tokens_per_step": (3.0, 2.0, 4.0)}}
    assert paper_ratios(tmp_path / "none.csv") == {}


def test_the_paper_s_own_file_has_the_ratios() -> None:
    if not PAPER.is_file():
        pytest.skip("../shared/paper/results.csv is not here")
    median, least, most = paper_ratios()["dynamic_cheatsheet"]["output_tokens_per_step"]
    assert least <= median <= most and most >= 5524.59 / 1634.2  # GPT-5


def row(**changes: Any) -> dict[str, Any]:
    figures = {
        **{"steps": 20, "calls_per_step": 1.0, "memory_calls_per_step": 0.0, "input_tokens_per_step": 100.0},
        **{"cached_tokens_per_step": 50.0, "output_tokens_per_step": 10.0, "retrieve_ms": 0.1},
        **{"bytes_half_way": 5, "bytes_at_end": 9, "malformed_share": 0.0},
    }
    return figures | changes


def test_the_table_says_where_ours_differ(tmp_path: Path) -> None:
    about = {"steps": 20, "preset": "rl", "model": "m", "command": "c"}
    rows = {
        "base": row(),
        "amem": row(input_tokens_per_step=500.0, memory_calls_per_step=0.25, malformed_share=0.5, preset="rl"),
        "ace": {"failed": "it broke"},
    }
    text = markdown(rows, paper_ratios(csv(tmp_path)), about)
    (amem,) = [line for line in text.splitlines() if line.startswith("| amem")]
    cells = [c.strip() for c in amem.split("|")[1:-1]]
    assert cells == [
        *("amem", "rl", "1.00", "0.25", "500", "50", "10", "0.10", "5", "9", "50 %"),
        *("5.00", "3.00 (2.00 to 4.00)", "1.00", ""),
    ]
    assert "- `amem`, tokens in: 5.00 of base, more than the paper's 2.00 to 4.00: 0.25 memory calls" in text
    assert "| ace | failed: it broke |" in text
    within = markdown({"base": row(), "amem": row(input_tokens_per_step=300.0)}, paper_ratios(csv(tmp_path)), about)
    assert within.endswith("No ratio lies outside the paper's range.\n")


def test_an_episode_is_measured() -> None:
    llm = ScriptedLLM(lambda request: request.sampling.choices[0] if request.sampling.choices else "WAIT(10)")
    figures = played("base", llm, steps=3, preset="rl")
    assert figures["steps"] == 3 and figures["memory_calls_per_step"] == 0 and figures["malformed_share"] == 0
    assert 0 < figures["bytes_half_way"] <= figures["bytes_at_end"] and figures["input_tokens_per_step"] > 0
    # Every answer of memory is nonsense: two questions every three steps, a share of 1.
    memory = played("summary", ScriptedLLM(lambda request: ""), steps=9, preset="rl")
    assert memory["memory_calls_per_step"] > 0 and memory["malformed_share"] == 1.0
