"""Reports: what stands in them, in every form, from a played matrix."""

from __future__ import annotations

import csv
import io
import json
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest

from agentspec.cli import main
from agentspec.files import write_lines
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.policies import Policy
from agentspec.spec import AgentSpec
from agentspec.types import Task
from eval.matrix import evaluate
from eval.report import build_report, write_files
from eval.report.blocks import Figure, Table, Text, to_html, to_latex
from eval.report.data import as_parquet
from eval.report.figures import pareto_front
from eval.report.modules import pooled
from tests.toy_env import TOY

SPECS = {
    f"{reasoning}+{memory}": AgentSpec.from_data({"reasoning": reasoning, "memory": memory, "layout": "snapshot"})
    for reasoning in ("direct", "react")
    for memory in ("none", "base")
} | {"reflecting": AgentSpec.from_data({"reasoning": "direct", "reflection": "self_refine"})}


def trader(request: Request) -> str:
    """Sells always, or with a memory only now and then: scaffolds differ."""
    text = "".join(str(part) for message in request.messages for part in message.content)
    return "SELL()" if "Earlier" not in text and len(text) % 3 else "WAIT()"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("matrix")
    policies = [Policy("random"), *(Policy("trader", f"t{i}", run=str(i)) for i in range(3))]
    tasks = {
        "toy": [Task(TOY, s) for s in range(4)],
        "grid": [Task("minigrid", s, {"action_mode": "menu"}) for s in (0, 1)],
    }

    def make(policy: Policy) -> ScriptedLLM | None:
        return None if policy.scripted else ScriptedLLM(lambda r: "turn left" if r.sampling.choices else trader(r))

    evaluate(policies, SPECS, tasks, out=out, make_llm=make, trajectories=True, max_steps=12)
    return out


def test_a_report_has_its_sections_and_says_what_its_numbers_are(folder: Path) -> None:
    report = build_report(folder, title="Toy", paper=True)
    text = to_html(report.blocks, "Toy")
    for heading in ("toy: policy x scaffold", "reasoning x memory", "reflection", "what it costs", "Failures", "Costs"):
        assert heading in text, heading
    captions = [b.caption for b in report.blocks if isinstance(b, Table | Figure)]
    assert any("n = 4 tasks x 1 repeats of up to 3 training runs; 95% t intervals" in c for c in captions)
    assert all(caption.strip() for caption in captions)
    # What was read is named by its digest.
    assert "results.jsonl" in text and "SHA-256" in text


def test_a_heat_map_says_what_else_its_cells_differ_in() -> None:
    def row(reasoning: str, memory: str, layout: str) -> dict[str, Any]:
        return {"agent": {"reasoning": reasoning, "memory": memory, "layout": layout, "scope": "episode"}}

    alike = [row(r, m, "snapshot") for r in ("direct", "react") for m in ("none", "base")]
    assert pooled(alike) == ""
    text = pooled([row("direct", "none", "conversation"), *alike[1:]])
    assert "differ in layout too (conversation in direct x none; snapshot in the others)" in text
    text = pooled([row("direct", "none", "conversation"), *alike])
    assert "conversation and snapshot in direct x none" in text


def test_every_form_is_written_and_well_formed(folder: Path, tmp_path: Path) -> None:
    report = build_report(folder)
    written = write_files(report, tmp_path)
    names = {path.relative_to(tmp_path).as_posix() for path in written}
    assert {"report.html", "report.md", "report.tex", "episodes.csv"} <= names
    page = (tmp_path / "report.html").read_text()
    assert "<script" not in page and "http://" not in page.replace("http://www.w3.org", "").replace(
        "http://purl", ""
    ).replace("http://creativecommons", "")
    for path in written:
        if path.suffix == ".svg":
            ET.parse(path)
    rows = list(csv.DictReader((tmp_path / "episodes.csv").open()))
    assert len(rows) == len(report.rows) and rows[0]["agent_reasoning"]
    pictures = [line for line in (tmp_path / "report.md").read_text().splitlines() if line.startswith("![")]
    assert pictures and all((tmp_path / line.split("](")[1].rstrip(")")).is_file() for line in pictures)


def test_the_same_rows_give_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_files(build_report(folder), tmp_path / name)
    for path in sorted((tmp_path / "a").rglob("*.*")):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes(), path.name


def test_latex_escapes_what_it_must() -> None:
    text = to_latex([Table(["a_b", "$/h"], [["50 % & more", "x^2 #1"]], "n < 3")])
    assert r"a\_b & \$/h \\" in text and r"50 \% \& more & x\textasciicircum{}2 \#1 \\" in text
    assert r"\caption{n \textless{} 3}" in text


def test_who_is_on_the_front() -> None:
    # (cost, value): the third costs more than the second and gives less; equals are both on it.
    assert pareto_front([(1, 1), (2, 3), (3, 2), (2, 3)]) == [0, 1, 3]


def test_from_the_command_line(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "run" / "metrics.jsonl"
    log.parent.mkdir()
    log.write_text("".join(json.dumps({"step": s, "reward": float(s)}) + "\n" for s in range(3)))
    command = ["report", str(folder), "--to", str(tmp_path / "out"), "--runs", f"grpo={log.parent}"]
    assert main(command) == 0
    assert "report.html" in capsys.readouterr().out
    assert "Learning curves" in (tmp_path / "out" / "report.html").read_text()
    with pytest.raises(SystemExit) as end:
        main(["report", str(tmp_path / "nowhere"), "--to", str(tmp_path / "x")])
    assert end.value.code == 2
    assert "give the folder of an evaluation" in capsys.readouterr().err
    (tmp_path / "episodes.jsonl").touch()  # killed before it could write its rows
    with pytest.raises(SystemExit):
        main(["report", str(tmp_path), "--to", str(tmp_path / "x")])
    assert "has not ended; run its command again" in capsys.readouterr().err


def hand_made(folder: Path, rows: list[dict[str, Any]]) -> Any:
    agent = {"reasoning": "react", "memory": "base", "reflection": "none", "layout": "conversation", "scope": "episode"}
    plain = {"tasks": "t", "run": "", "scaffold": "s", "rollout": 0, "status": "completed", "env": "minigrid"}
    write_lines(folder / "results.jsonl", [plain | {"agent": agent, "steps": 10} | row for row in rows])
    return build_report(folder, paper=True)


def tables(report: Any) -> list[Table]:
    return [block for block in report.blocks if isinstance(block, Table)]


def test_costs_per_step_are_those_of_episodes_with_steps(tmp_path: Path) -> None:
    call = {"calls": 10, "input_tokens": 1000, "output_tokens": 20, "cost": 0.5, "latency_s": 3.0}
    failed = {"status": "failed", "steps": None, "success": None}
    report = hand_made(
        tmp_path,
        [
            {"policy": "p", "task": "a", "success": 1.0, "modules": {"reasoning": call}},
            {"policy": "p", "task": "b", "modules": {"reasoning": call}, **failed},
        ],
    )
    [costs] = [t for t in tables(report) if "calls/step" in t.header]
    assert list(costs.body[0]) == ["p / s", "reasoning", "1.00", "100", "2.0", "1.0000", "6"]


def test_the_paper_stands_beside_models_whoever_comes_last(tmp_path: Path) -> None:
    scripted = dict.fromkeys(("memory", "reflection"), "none") | {"reasoning": "random", "layout": "", "scope": ""}
    rows = [
        {"policy": "model", "task": "a", "success": 1.0},
        {"policy": "random", "task": "a", "success": 0.0, "agent": scripted},
    ]
    [beside] = [t for t in tables(hand_made(tmp_path, rows)) if "median" in t.header]
    assert [row[0] for row in beside.body] == ["model"]


def test_too_few_tasks_promise_no_difference_and_labels_keep_their_pictures(tmp_path: Path) -> None:
    rows = [
        {"policy": policy, "task": f"{label}{i}", "tasks": label, "success": float(i == j)}
        for label in ("A", "a")
        for j, policy in enumerate("pq")
        for i in range(5)
    ]
    report = hand_made(tmp_path, rows)
    assert any("5 paired tasks are too few" in block.text for block in report.blocks if isinstance(block, Text))
    names = [block.name for block in report.blocks if isinstance(block, Figure)]
    assert len(set(names)) == len(names)


def test_a_column_of_mixed_kinds_is_text() -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = [{"policy": "p", "score": True}, {"policy": "q", "score": 0.5}, {"policy": "r", "score": None}]
    read = parquet.read_table(io.BytesIO(as_parquet(rows))).to_pydict()
    assert read["policy"] == ["p", "q", "r"] and read["score"] == ["True", "0.5", None]
