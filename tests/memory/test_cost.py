"""The table of what memories cost: figures of an episode, the paper's ratios, and where ours differ."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from benchmarks.memory_cost import TABLE, measure, played, settings_of
from benchmarks.memory_cost_table import PAPER, Told, markdown, paper_ratios

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
    # 200 / 100 and 40 / 10; with a reflector or in another world it is another agent. Medians of 100, 10 and 200, 40.
    assert paper_ratios(csv(tmp_path)) == {"amem": {"input_tokens_per_step": Told(3.0, 2.0, 4.0, 55.0, 120.0)}}
    assert paper_ratios(tmp_path / "none.csv") == {}


def test_the_paper_s_own_file_has_the_ratios() -> None:
    if not PAPER.is_file():
        pytest.skip("../shared/paper/results.csv is not here")
    told = paper_ratios()["dynamic_cheatsheet"]["output_tokens_per_step"]
    assert told.least <= told.ratio <= told.most and told.most >= 5524.59 / 1634.2  # GPT-5


def row(decision: float = 100.0, asked: float = 0.0, each: float = 0.0, **changes: Any) -> dict[str, Any]:
    """Figures of a memory: tokens that a decision reads, memory's calls per step, tokens that each reads."""
    purposes = {"link": {"calls_per_step": asked, "input_tokens": each, "output_tokens": 5.0}} if asked else {}
    figures = {
        **{"steps": 20, "calls_per_step": 1.0 + asked, "memory_calls_per_step": asked},
        **{"input_tokens_per_step": decision + asked * each, "cached_tokens_per_step": 50.0},
        **{"output_tokens_per_step": 10.0, "retrieve_ms": 0.1, "bytes_half_way": 5, "bytes_at_end": 9},
        "decision": {"calls_per_step": 1.0, "input_tokens": decision, "output_tokens": 10.0},
        "purposes": purposes,
        "malformed_share": 0.0,
    }
    return figures | changes


ABOUT = {"steps": 20, "preset": "rl", "model": "m", "command": "c"}


def test_the_table_has_a_line_a_method_and_one_a_purpose(tmp_path: Path) -> None:
    rows = {
        "base": row(),
        "amem": row(200.0, 0.25, 1200.0, malformed_share=0.5, preset="rl"),
        "ace": {"failed": "it broke"},
    }
    text = markdown(rows, paper_ratios(csv(tmp_path)), ABOUT)
    [amem] = [line for line in text.splitlines() if line.startswith("| amem | rl")]
    cells = [c.strip() for c in amem.split("|")[1:-1]]
    assert cells == [
        *("amem", "rl", "1.25", "0.25", "500", "50", "10", "0.10", "5", "9", "50 %"),
        *("5.00", "3.00 (2.00 to 4.00)", "1.00", ""),
    ]
    assert "| ace | failed: it broke |" in text
    assert "| amem | (decision) | 1.00 | 200 | 10 |" in text and "| amem | link | 0.25 | 1200 | 5 |" in text


def said(amem: dict[str, Any], folder: Path) -> str:
    """What is said of `amem`, for which the paper has 2 to 4 times the 100 tokens that base reads here."""
    text = markdown({"base": row(), "amem": amem}, paper_ratios(csv(folder)), ABOUT)
    return text.partition("## Where ours differ from the paper\n\n")[2]


def test_the_sentence_follows_from_the_method_s_own_calls(tmp_path: Path) -> None:
    assert said(row(300.0), tmp_path) == "No ratio lies outside the paper's range.\n"
    # 200 + 0.25 x 1200 = 500: decisions alone would be within the range.
    calls = said(row(200.0, 0.25, 1200.0, malformed_share=0.5), tmp_path)
    assert "5.00 of base, more than the paper's 2.00 to 4.00. Decisions read 200 tokens a step (with base 100)" in calls
    assert "memory's own calls 300: `link` 0.25 a step of 1200." in calls
    assert "without them it would be 2.00" in calls and "50 % of its answers could not be used" in calls
    # Decisions alone are above it.
    prompts = said(row(450.0, 0.1, 10.0), tmp_path)
    assert "Decisions alone are at 4.50" in prompts and "without them" not in prompts
    # 120 + 0.1 x 100 = 130, which is 70 short of 2 x 100: 0.7 more calls of 100 tokens; rl writes every 6 steps.
    few = said(row(120.0, 0.1, 100.0, preset="rl"), tmp_path)
    assert "1.30 of base, less than the paper's 2.00 to 4.00" in few
    assert "70 are missing here: 0.70 more calls a step of this size (it makes 0.10)" in few
    assert "Preset `rl` sets `every` 6 (`paper`: 1), `top` 2 (`paper`: 10)" in few
    none = said(row(150.0), tmp_path)
    assert "memory asks the model nothing" in none and "50 tokens a step are missing here." in none


def test_what_the_paper_saves_is_more_than_our_prompt_has(tmp_path: Path) -> None:
    # There 500 tokens become 100 (0.2 of base); here base reads 100, so no memory could save 400.
    paper = {"amem": {"input_tokens_per_step": Told(0.2, 0.1, 0.3, 500.0, 100.0)}}
    text = markdown({"base": row(), "amem": row(110.0)}, paper, ABOUT)
    assert "takes the place of 400 tokens, more than our base reads at all" in text


def answer(request: Request) -> str:
    return request.sampling.choices[0] if request.sampling.choices else "WAIT(10)"


def test_an_episode_is_measured() -> None:
    given = {"preset": "rl", "model": "scripted"}
    figures = played(settings_of("base", steps=3, **given), ScriptedLLM(answer))
    assert figures["steps"] == 3 and figures["memory_calls_per_step"] == 0 and figures["malformed_share"] == 0
    assert 0 < figures["bytes_half_way"] <= figures["bytes_at_end"] and figures["input_tokens_per_step"] > 0
    # Every answer of memory is nonsense: two questions every three steps, a share of 1.
    memory = played(
        settings_of("summary", steps=9, **given), ScriptedLLM(lambda r: answer(r) if r.sampling.choices else "")
    )
    assert memory["memory_calls_per_step"] > 0 and memory["malformed_share"] == 1.0
    # What the calls are for adds up to the tokens of a step.
    parts = [memory["decision"], *memory["purposes"].values()]
    assert list(memory["purposes"]) == ["summary"]
    assert sum(p["calls_per_step"] * p["input_tokens"] for p in parts) == pytest.approx(memory["input_tokens_per_step"])


def test_a_method_that_was_measured_is_not_played_again(tmp_path: Path) -> None:
    given = {"steps": 3, "preset": "rl", "model": "scripted"}
    asked = []

    def counted(request: Request) -> str:
        asked.append(request.tag.path)
        return answer(request)

    assert measure(["base"], given, tmp_path, llm=ScriptedLLM(counted)) == 0
    first, file = len(asked), tmp_path / "base.json"
    before = json.loads(file.read_text())
    assert first >= 3 and before["settings"]["steps"] == 3 and before["figures"]["steps"] == 3
    # Another method, one at a time: base is not asked again, and the table has both.
    assert measure(["summary"], given, tmp_path, llm=ScriptedLLM(counted)) == 0
    assert json.loads(file.read_text()) == before and len(asked) > first
    table = (tmp_path / TABLE).read_text()
    assert "| base |  |" in table and "| summary |" in table
    asked.clear()
    assert measure(["summary"], given, tmp_path, llm=ScriptedLLM(counted)) == 0 and not asked
    # Other settings are another measurement; the table of those has only what was measured so.
    assert measure(["base"], {**given, "steps": 2}, tmp_path, llm=ScriptedLLM(counted)) == 0 and asked
    assert "| summary |" not in (tmp_path / TABLE).read_text()


def test_a_method_that_failed_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = {"steps": 2, "preset": "rl", "model": "scripted"}

    async def fails(settings: object, llm: object) -> dict[str, str]:
        return {"failed": "no such city"}

    monkeypatch.setattr("benchmarks.memory_cost.play", fails)
    assert measure(["base"], given, tmp_path, llm=ScriptedLLM(answer)) == 1
    assert "failed: no such city" in (tmp_path / TABLE).read_text()
    monkeypatch.undo()
    assert measure(["base"], given, tmp_path, llm=ScriptedLLM(answer)) == 0
    assert "failed:" not in (tmp_path / TABLE).read_text()
