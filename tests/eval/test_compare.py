"""Two episodes side by side: where they part, what is drawn, what is coloured."""

from __future__ import annotations

from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from agentspec.cli import main
from agentspec.episode import Job, Runner
from agentspec.llm.scripted import ScriptedLLM
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory, write_trajectories
from agentspec.types import Task
from eval.compare import Side, compare_page, parting, route, shade

COURIER = Task("deliverybench", 0, {"size": "tiny", "shift_hours": 1.0})


def play(*answers: str, task: Task = COURIER) -> Trajectory:
    spec = AgentSpec.from_data({"reasoning": "direct"})
    return Runner(spec, ScriptedLLM(list(answers)), max_steps=len(answers)).run([Job(task)])[0]


A = play("VIEW_ORDERS()", "ACCEPT_ORDER(0)", "MOVE(x=100, y=100)", "WAIT(60)")
B = play("VIEW_ORDERS()", "WAIT(60)", "MOVE(x=100, y=100)")


class Balanced(HTMLParser):
    """Every element that is opened is closed, in order."""

    VOID = ("meta", "img", "br", "path", "use", "image", "rect", "line", "circle", "polygon", "polyline")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag


def test_where_they_part() -> None:
    assert parting(A, B) == 1 and parting(A, A) is None
    assert parting(A, replace(A, transitions=A.transitions[:2])) == 2


def test_the_page_shows_both_and_is_well_formed() -> None:
    page = compare_page(Side("first", A, 1.5), Side("second", B, -0.5))
    reader = Balanced()
    reader.feed(page)
    assert reader.open == [] and "<script" not in page
    assert "They part at step 1" in page and page.count('class="pair parted"') == 1
    assert "first +1.500, second -0.500" in page
    assert page.count("(ended)") == 1 and "ACCEPT_ORDER(0)" in page
    # Trained answers are coloured by their side's advantage, and prompts are there as text.
    assert shade(1.5) in page and shade(-0.5) in page and "<summary>prompt</summary>" in page


def test_routes_and_gauges_come_from_what_the_world_reports() -> None:
    assert len(route(A)) == 4 and route(A)[0] == route(B)[0]
    page = compare_page(Side("first", A), Side("second", B))
    assert "Routes; a ring marks the start" in page and "not trained on" in page


def test_colours() -> None:
    assert shade(2.0) == shade(9.0) == "rgba(0,114,178,0.50)" and shade(0.0).endswith("0.00)")


def test_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_trajectories(tmp_path / "a.jsonl", [A])
    write_trajectories(tmp_path / "b.jsonl", [play("WAIT(5)", task=replace(COURIER, seed=3)), B])
    page = tmp_path / "page.html"
    assert main(["compare", str(tmp_path / "a.jsonl"), f"other={tmp_path / 'b.jsonl'}", "--to", str(page)]) == 0
    assert "other" in page.read_text() and "They part at step 1" in page.read_text()
    capsys.readouterr()
    for b, message in (("b.jsonl#0", "different tasks"), ("b.jsonl#7", "no episode 7"), ("c.jsonl", "no file")):
        with pytest.raises(SystemExit):
            main(["compare", str(tmp_path / "a.jsonl"), str(tmp_path / b), "--to", str(page)])
        assert message in capsys.readouterr().err
