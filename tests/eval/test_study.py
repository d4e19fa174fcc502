"""Studies as data: what is read and refused, what is estimated, what the report makes of their runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from agentspec.files import append_lines, write_lines
from agentspec.metrics import columns
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.types import Task
from eval.report import build_report
from eval.report.blocks import Table, Text
from eval.statistics import minimum_detectable_effect
from eval.study import read_study
from eval.study.cost import Rates, Rounds, Work, plan, work_of
from eval.tables import VERDICTS

STUDY: dict[str, Any] = {
    "out": "runs/x",
    "scaffolds": {"plain": {}, "noted": {"memory": "base"}},
    "arms": {"a": {"scaffold": "plain"}, "b": {"scaffold": "noted", "trainer": "memory", "max_steps": 3}},
    "seeds": [0, 1, 2],
    "tasks": 4,
}


def test_a_study_is_read() -> None:
    study = read_study({**STUDY, "evaluation": {"concurrency": 2, "backend": {"dtype": "bfloat16"}}})
    assert (study.arms["b"].trainer, study.arms["b"].fields) == ("memory", {"max_steps": 3})
    # Seed by seed: who stops early has whole replicates.
    assert study.runs[:3] == [("a", 0), ("b", 0), ("a", 1)]
    assert study.settings.concurrency == 2 and study.ended == []
    start, *rest = study.policies("model", "start-adapter")
    assert (start.name, start.adapter, start.backend) == ("start", "start-adapter", {"dtype": "bfloat16"})
    assert [policy.name for policy in rest] == ["rule_based", "random"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seedz": [0]}, "unknown key 'seedz' in a study; did you mean seeds"),
        ({"arms": {}}, "`arms` is missing"),
        ({"arms": {"a": {"scaffold": "plian"}}}, "unknown scaffold 'plian'; did you mean plain"),
        ({"arms": {"a": {"scaffold": "plain", "trainer": "ppo"}}}, "unknown trainer 'ppo'"),
        ({"arms": {"a": {"scaffold": "plain", "agent": {}}}}, "its agent is the scaffold 'plain'"),
        ({"arms": {"start": {"scaffold": "plain"}}}, "under another name than 'start'"),
        ({"table": {"GRPO": "c"}}, "table names the policy 'c'"),
        ({"compare": {"x": ["a"]}}, "expected two policies"),
        ({"seeds": [0, 0]}, "different seeds"),
        ({"evaluation": {"concurency": 2}}, "concurency"),
        ({"scaffolds": {"plain": {"memory": "bsae"}}}, "did you mean base"),
    ],
)
def test_what_is_no_study(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        read_study({**STUDY, **changes})


def test_rates_say_where_they_are_from() -> None:
    assert Rates.from_data({"read": 1, "write": 2, "update": 3, "source": "a stopwatch"}).source == "a stopwatch"
    for given, message in (({"read": 1}, "write, update missing"), ({"raed": 1}, "unknown key 'raed'")):
        with pytest.raises(SpecError, match=message):
            Rates.from_data(given)
    with pytest.raises(SpecError, match="update must be above 0"):
        Rates(1, 1, 0)


def test_hours_by_hand() -> None:
    study = read_study({**STUDY, "deviation": 1.0})
    works = {"plain": [Work(100, 10, 5), Work(200, 20, 9)], "noted": [Work(300, 30, 5), Work(600, 60, 9)]}
    text = plan(study, {"a": Rounds(2, 6), "b": Rounds(4, 6)}, works, Rates(100, 10, 11, 2.0, "by hand"))
    # An episode of `plain`: 100/100 + 10/10 = 2 s to play, 110/11 = 10 s to train on; three times that in `noted`.
    # a: 3 runs x 2 updates x 6 rollouts = 36 episodes x 12 s = 432 s = .12 h. b: 72 x 36 s = 2592 s = .72 h.
    assert "3 runs x 2 updates x 6 rollouts =    36 episodes  0.12-0.24 h" in text
    assert "3 runs x 4 updates x 6 rollouts =    72 episodes  0.72-1.44 h" in text
    # The start and six runs x 4 tasks x (2 + 6) s / 2 = 112 s = .03 h.
    assert "7 policies x 2 scaffolds x 4 episodes = 56 episodes" in text
    assert "training 0.84-1.68, evaluation 0.03-0.06, warm start 0.00; in all 0.87-1.74" in text
    assert "rates (by hand): read 100, write 10, update 11" in text
    # An arm: three runs. The diagonal: six contrasts, of which each arm's mean takes a degree of freedom: 2 x 2 + 1.
    one, whole = minimum_detectable_effect(1.0, 3), minimum_detectable_effect((5 / 6) ** 0.5, 5)
    assert f"from {one:.3g} on, the diagonal (6 runs) from {whole:.3g} on" in text
    assert "one run an arm says nothing" in plan(
        read_study({**STUDY, "deviation": 1.0, "seeds": [0]}),
        {"a": Rounds(1, 1), "b": Rounds(1, 1)},
        works,
        Rates(1, 1, 1),
    )


def test_tokens_are_counted_once_however_often_a_prompt_repeats_them() -> None:
    pytest.importorskip("minigrid")
    pytest.importorskip("trl")
    from agentspec.demonstration import play_expert
    from tests.tiny import tiny_tokenizer

    tasks = [Task("minigrid", 0, {"suite": "memory", "observation": "compact", "action_mode": "menu"})]
    spec = AgentSpec.from_data({"sampling": {"max_tokens": 64}})
    (episode,) = play_expert(spec, tiny_tokenizer(), tasks)
    work = work_of(spec, tiny_tokenizer(), tasks, "rule_based")
    # A growing conversation is read once: the last prompt, and the answer after it.
    last = episode.calls[-1]
    assert work.read + work.write == len(last.prompt_ids) + len(last.completions[0].token_ids)
    assert work.steps == len(episode.transitions) and 0 < work.write < work.read


AGENT = {"reasoning": "direct", "memory": "base", "reflection": "none", "layout": "snapshot", "scope": "episode"}
GRID = {"start": (1, 1), "a": (5, 1), "b": (1, 5)}


def reported(folder: Path, runs: int) -> list[Any]:
    """A report of arms a and b, at home in x and y: what they earn there is 4 more, and a run's number / 10 more."""
    rows = []
    for policy, values in GRID.items():
        for run in range(runs if policy != "start" else 1):
            for scaffold, value in zip("xy", values, strict=True):
                for task in "mn":
                    earned = value + (run / 10 if scaffold == "x" else 0.0)
                    row = {"policy": policy, "run": "" if policy == "start" else str(run), "scaffold": scaffold}
                    row |= {"task": task, "tasks": "t", "rollout": 0, "status": "completed", "env": "deliverybench"}
                    row |= {"net_earnings": earned, "input_tokens": 100, "output_tokens": 5, "agent": AGENT}
                    rows.append(row | {"key": f"{policy}{run}{scaffold}{task}", "steps": 2})
    write_lines(folder / "results.jsonl", rows)
    logged = {"calls/memory.m/write/tokens": 10.0, "calls/memory.m/write/advantage_mass": 0.25}
    logged |= {"calls/memory.m/write/entropy": 1.5, "episode/input_tokens": 50.0, "episode/output_tokens": 2.0}
    arms = {}
    for arm, home in (("a", "x"), ("b", "y")):
        places = {str(run): f"runs/{arm}{run}" for run in range(runs)}
        for place in places.values():
            # Two steps of one generation round (`num_iterations: 2`): a line of the log each, one receipt.
            append_lines(folder / place / "metrics.jsonl", *({"step": s, "reward": 0.0, **logged} for s in (1, 2)))
            append_lines(folder / place / "updates.jsonl", {"round": 1})
        arms[arm] = {"scaffold": home, "trainer": "grpo", "rollouts": 6, "runs": places}
    audits = {"a0": {"updates": 1, "violations": ["row 3 was edited"], "notes": [], "head": "abc"}}
    told = {"arms": arms, "audits": audits, "table": {"Non-RL": "start", "GRPO": "a"}, "compare": {"which": ["a", "b"]}}
    (folder / "study.json").write_text(json.dumps(told))
    append_lines(folder / "costs.jsonl", {"what": "train a", "cpu_s": 1800}, {"what": "train a", "cpu_s": 1800})
    blocks = build_report(folder).blocks
    return [b for b in blocks if isinstance(b, Table | Text)]


def table(blocks: list[Any], *columns: str) -> dict[str, list[str]]:
    [found] = [b for b in blocks if isinstance(b, Table) and b.header[0] == columns[0] and set(columns) <= {*b.header}]
    return {row[0]: list(row) for row in found.body}


def test_the_report_of_a_study(tmp_path: Path) -> None:
    blocks = reported(tmp_path, runs=3)
    paper = table(blocks, "evaluated in", "Non-RL", "GRPO")
    assert paper["y"][1].startswith("1.00") and paper["x"][2].startswith("5.10") and paper["x"][3] == "105"
    matrix = table(blocks, "policy", "trained in")
    assert matrix["a"][1:3] == ["x", "3"] and matrix["a"][3].endswith("(home)") and "home" not in matrix["a"][4]
    tested = table(blocks, "difference", "verdict", "n")
    # Contrasts of a: 4, 4.1, 4.2; of b: 4, 3.9, 3.8. Their mean over homes is 4.
    assert tested["diagonal less the rest"][1].startswith("4.00 [")
    assert tested["diagonal less the rest"][3:] == ["higher", "6 runs"]
    assert any("not possible with 2 homes" in b.text for b in blocks if isinstance(b, Text))
    pairs = table(blocks, "question", "memory calls/episode")
    assert pairs["which"][1] == "b - a"
    assert table(blocks, "trained", "advantage mass")["a"][1:6] == ["memory.m/write", "3", "10", "0.25", "1.500"]
    taken = table(blocks, "what", "CPU hours")
    # Three runs of one update with six rollouts of 50 tokens in and 2 out; two processes of half an hour.
    assert taken["train a"][1:] == ["18", "900", "36", "1.00"]
    assert taken["evaluation"][1:4] == ["28", "2,800", "140"] and taken["in all"][4] == "1.00"
    assert table(blocks, "run", "violations")["a0"][1:3] == ["1", "1"]
    assert any("row 3 was edited" in b.text for b in blocks if isinstance(b, Text))


def test_a_tie_is_printed_as_one_and_two_runs_speak_of_their_checkpoints(tmp_path: Path) -> None:
    blocks = reported(tmp_path, runs=2)
    tested = table(blocks, "difference", "verdict", "n")
    # Two tasks: of four flips two are as far, so p is .5 whatever was measured.
    assert tested["diagonal less the rest"][3:] == ["tie", "2 tasks; this checkpoint only"]
    assert all("this checkpoint only" in row[-1] for row in table(blocks, "trained", "gain").values())


def test_results_without_a_study_have_no_such_section(tmp_path: Path) -> None:
    reported(tmp_path, runs=3)
    (tmp_path / "study.json").unlink()
    assert not any(isinstance(b, Table) and "trained in" in b.header for b in build_report(tmp_path).blocks)


def test_the_corrected_p_decides_every_verdict(tmp_path: Path) -> None:
    """Over tasks p is of a sign-flip test and the interval Student's: they disagree in both directions."""
    from eval.report.transfer import _difference
    from eval.statistics import paired
    from eval.tables import difference_rows, differences

    metric = next(m for m in columns([{"env": "deliverybench", "net_earnings": 1.0}]) if m.name == "net_earnings")
    # Twelve gains of one sign, one of them huge: of 4,096 flips two are as far, but Student's interval holds 0.
    higher = {str(t): 0.1 if t else 50.0 for t in range(12)}
    # Four equal gains: the interval is a point, and of eight flips of four, two are as far.
    tie = {str(t): 1.0 for t in range(4)}
    for gains, verdict in ((higher, "higher"), (tie, "tie")):
        e = paired(gains, dict.fromkeys(gains, 0.0))
        assert (e.low <= 0 <= e.high) == (verdict == "higher") and (e.p <= 0.05) == (verdict == "higher")
        assert _difference(e, metric)[2] == verdict
        rows = [
            {
                "tasks": "t",
                "policy": policy,
                "scaffold": "s",
                "task": t,
                "status": "completed",
                "y": value * (policy == "b"),
            }
            for policy in "ab"
            for t, value in gains.items()
        ]
        assert [line[4] for line in difference_rows(differences(rows, "y"), "policy", 2)[1]] == [verdict]
    captions = [b.caption for b in reported(tmp_path, runs=2) if isinstance(b, Table) and "verdict" in b.header]
    assert len(captions) >= 3 and all(VERDICTS in caption for caption in captions)


def test_an_arm_without_runs_is_left_out_and_said_so(tmp_path: Path) -> None:
    reported(tmp_path, runs=3)
    told = json.loads((tmp_path / "study.json").read_text())
    told["arms"]["late"] = {"scaffold": "z", "trainer": "grpo", "rollouts": 6, "runs": {}}
    told["compare"]["late"] = ["late", "a"]
    (tmp_path / "study.json").write_text(json.dumps(told))
    blocks = [b for b in build_report(tmp_path).blocks if isinstance(b, Table | Text)]
    assert any("No run of late was evaluated" in b.text for b in blocks if isinstance(b, Text))
    assert "late" not in table(blocks, "policy", "trained in") and "late" not in table(blocks, "trained", "gain")
    assert table(blocks, "difference", "verdict", "n")["diagonal less the rest"][3] == "higher"
    # Without any run of b there is one home left, and nothing to compare it with.
    told["arms"]["b"]["runs"] = {}
    (tmp_path / "study.json").write_text(json.dumps(told))
    lines = (tmp_path / "results.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "results.jsonl").write_text("".join(line for line in lines if '"policy": "b"' not in line))
    texts = [b.text for b in build_report(tmp_path).blocks if isinstance(b, Text)]
    assert any("Not tested: a diagonal needs two scaffolds" in text for text in texts)


def test_a_single_run_of_an_arm_is_no_constant(tmp_path: Path) -> None:
    """Three runs of a against one of b, in pairs and at home: about these checkpoints. The start is a constant."""
    reported(tmp_path, runs=3)
    lines = (tmp_path / "results.jsonl").read_text().splitlines(keepends=True)
    kept = [line for line in lines if (row := json.loads(line))["policy"] != "b" or row["run"] == "0"]
    (tmp_path / "results.jsonl").write_text("".join(kept))
    blocks = [b for b in build_report(tmp_path).blocks if isinstance(b, Table | Text)]
    tested = table(blocks, "difference", "verdict", "n")
    assert all("this checkpoint only" in row[-1] for row in tested.values()) and len(tested) == 3
    assert "this checkpoint only" in table(blocks, "question", "memory calls/episode")["which"][-1]
    assert table(blocks, "trained", "gain")["a"][-1] == "3 runs"
