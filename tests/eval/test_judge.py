"""A model as judge of failures: what it is shown, how it answers, and how it is measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from agentspec.failures import LEAVES, is_failure
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import SpecError
from agentspec.types import Task
from eval import labels
from eval.failures import diagnose, replayed
from eval.judge import NONE, Judge, judged, read_kind
from eval.labels import SAMPLE, UNSEEN, Agreement, Sample, agreed, agreement, beside_rules, kappa_of, read_labels
from eval.transcripts import excerpt, transcript

STRATEGY, STUCK = "understanding/knowledge/strategy", "grounding/spatial/stuck"
COURIER = Task("deliverybench", 0, {"size": "tiny", "shift_hours": 1.0})


class Free(ScriptedLLM):
    """A model behind an endpoint: it cannot be held to choices."""

    def __init__(self, script: Any) -> None:
        super().__init__(script)
        self.capabilities = frozenset({"choices", "n"})


@pytest.fixture(scope="module")
def sample() -> Sample:
    return Sample.read(UNSEEN)


def count(text: str) -> int:
    return len(text) // 4


def test_an_excerpt_keeps_task_end_and_every_refusal() -> None:
    wrong = "CHARGE(target_pct=80)"
    episode = replayed(COURIER, [*["WAIT(10)"] * 9, wrong, *["WAIT(10)"] * 9, wrong, *["WAIT(10)"] * 9])
    whole = transcript(episode)
    assert excerpt(episode, count(whole), count) == whole
    short = excerpt(episode, 1500, count)
    assert count(short) <= 1500 < count(whole)
    assert short.startswith(whole[:200]) and short.splitlines()[-1] == whole.splitlines()[-1]
    assert short.count(f"DOES: {wrong}") == 2 == short.count("ANSWER: failed: there is no charging station")
    shown = [int(line.split()[1]) for line in short.splitlines() if line.startswith("STEP ")]
    assert shown == sorted(shown) and {0, 9, 19, 28} <= {*shown}  # both ends, and the refusals in the middle
    left_out = [int(line[1:].split()[0]) for line in short.splitlines() if "left out]" in line]
    assert sum(left_out) + len(shown) == 29
    assert short.count("SEES:") < len(shown)  # of some steps only what was done


@pytest.mark.parametrize("room", [400, 900, 2000, 6000])
def test_excerpts_fit_whatever_was_played(sample: Sample, room: int) -> None:
    for episode in sample.episodes.values():
        text = excerpt(episode, room, count)
        assert count(text) <= room * 1.05 and text.splitlines()[-1].startswith("END: ")


def test_a_judge_that_can_be_constrained_chooses_a_name() -> None:
    seen: list[Request] = []

    def answer(request: Request) -> str:
        seen.append(request)
        return STRATEGY

    episode = replayed(COURIER, ["VIEW_ORDERS()", "WAIT(10)"])
    judge = Judge(ScriptedLLM(answer), most_prompt=100_000)
    assert judge.ask(episode) == STRATEGY and judge.unreadable == 0
    [request] = seen
    assert request.sampling.choices == (*LEAVES, NONE) and request.sampling.temperature == 0
    assert (
        all(leaf in request.messages[0].text for leaf in LEAVES) and "name and nothing else" in request.messages[0].text
    )
    assert "DOES: WAIT(10)" in request.messages[1].text and "END: " in request.messages[1].text


def test_a_judge_behind_an_endpoint_answers_in_json() -> None:
    answers = iter(
        [f'```json\n{{"kind": "{STUCK}", "why": "it turns"}}\n```', '{"kind": "none", "why": ""}', "no idea"]
    )
    judge = Judge(Free(lambda request: next(answers)), most_prompt=100_000)
    assert not judge.choices and "JSON only" in judge.instruction
    episode = replayed(COURIER, ["WAIT(10)"])
    assert [judge.ask(episode) for _ in range(3)] == [STUCK, "", ""]
    assert (judge.asked, judge.unreadable) == (3, 1)


def test_answers_are_read_where_they_name_one_kind() -> None:
    assert read_kind(f"I would say {STUCK}.") == STUCK and read_kind(" none ") == NONE
    assert read_kind(f"{STUCK} or {STRATEGY}") == "" == read_kind('{"kind": "lazy"}')


def test_a_judge_decides_only_what_the_rules_leave_open() -> None:
    grid = Task("minigrid", 0, {"level": "MiniGrid-Empty-6x6-v0"})
    pytest.importorskip("minigrid")
    judge = Judge(ScriptedLLM([STRATEGY]), most_prompt=100_000)
    quiet, turning = replayed(grid, ["TURN_LEFT()", "FORWARD()"]), replayed(grid, ["TURN_LEFT()"] * 100)
    assert diagnose(quiet).leaf == "open"
    found = diagnose(quiet, judge)
    assert (found.leaf, found.judged) == (STRATEGY, True)
    assert diagnose(turning, judge).leaf == STUCK and judge.asked == 1
    assert diagnose(quiet, Judge(ScriptedLLM([NONE]), most_prompt=100_000)).leaf == "open"


def test_a_prompt_without_room_is_refused() -> None:
    with pytest.raises(ValueError, match=r"leaves -?[0-9]+ for an episode"):
        Judge(ScriptedLLM([NONE]), most_prompt=900)


def test_answers_are_kept_and_gone_on_with(sample: Sample, tmp_path: Path) -> None:
    episodes = dict([*sample.episodes.items()][:4])
    path, told = tmp_path / "answers.jsonl", list[str]()
    asked: list[Request] = []

    def breaks(request: Request) -> str:
        asked.append(request)
        if len(asked) == 3:
            raise RuntimeError("the line is down")
        return STUCK

    judge = Judge(ScriptedLLM(breaks), most_prompt=20_000)
    with pytest.raises(RuntimeError, match="the line is down"):
        judged(judge, {"model": "x"}, episodes, path, told.append)
    assert [json.loads(line)["episode"] for line in path.read_text().splitlines()] == ["001", "002"]
    judged(judge, {"model": "x"}, episodes, path, told.append)
    assert len(asked) == 5 and read_labels(path, episodes) == dict.fromkeys(episodes, frozenset({STUCK}))
    judged(judge, {"model": "x"}, episodes, path, told.append)
    assert len(asked) == 5 and told[-1].startswith(f"2 of 2: {STUCK}; ")
    for other, by in ((judge, {"model": "y"}), (Judge(ScriptedLLM(breaks), most_prompt=9000), {"model": "x"})):
        with pytest.raises(SpecError, match=r"answers.jsonl holds answers of another judge, or to other prompts"):
            judged(other, by, episodes, path, told.append)


def test_a_judge_is_set_beside_the_rules(sample: Sample) -> None:
    """Recomputed by another way: over pairs of episode and kind that are not disputed."""
    both, disputed = agreed(sample.a, sample.b)
    rules, said = sample.rules(), dict.fromkeys(sample.episodes, frozenset({STRATEGY}))
    text = beside_rules(sample, said, "a judge")
    rows = {line.split(" | ")[0].strip("| "): line.split(" | ")[1:] for line in text.splitlines() if line[:2] == "| "}
    open_ = [e for e, t in sample.episodes.items() if is_failure(t) and not rules[e]]
    used = {e: rules[e] | ({STRATEGY} if e in open_ else set()) for e in rules}
    for name, mine in (("rules", rules), ("a judge", said), ("rules, and a judge where they are silent", used)):
        whole = sum(agreement(both, mine, disputed).values(), Agreement(0, 0, 0))
        kappas = (kappa_of(mine, sample.a), kappa_of(mine, sample.b))
        shares = [f"{x or 0:.2f}" for x in (whole.precision, whole.recall, *kappas)]
        assert [cell.strip(" |") for cell in rows[name]] == [str(whole.said), str(whole.both), *shares]
    right = sum(STRATEGY in both[e] for e in open_)
    assert f"names a kind in {len(open_)} of them, in {right} one that both readers say" in text and open_
    ceiling = sum(bool(kinds) for kinds in both.values()) / sum(map(len, both.values()))
    assert f"bounds recall by {ceiling:.2f}" in text


def test_one_command_asks_and_prints(
    monkeypatch: pytest.MonkeyPatch, sample: Sample, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[dict[str, Any]] = []

    def build(settings: dict[str, Any]) -> ScriptedLLM:
        made.append(settings)
        return ScriptedLLM([NONE])

    monkeypatch.setattr(labels, "build_llm", build)
    path = tmp_path / "answers.jsonl"
    arguments = [str(UNSEEN), "--judge", "smollm2-135m", "--llm", "dtype=bfloat16", "--max-prompt", "9000"]
    labels.main([*arguments, "--to", str(path)])
    printed = capsys.readouterr()
    assert made[0]["dtype"] == "bfloat16" and "36 of 36: none" in printed.err
    silent = dict.fromkeys(sample.episodes, frozenset[str]())
    assert printed.out.strip() == beside_rules(sample, read_labels(path, sample.episodes), "smollm2-135m")
    assert read_labels(path, sample.episodes) == silent
    labels.main([str(UNSEEN), "--answers", str(path)])  # the same file, scored kind by kind
    assert "| all |" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        labels.main(arguments)


def test_the_documentation_says_what_the_small_model_answered() -> None:
    """It named the first kind of the list in every episode of both samples."""
    text = (Path(__file__).parents[2] / "docs/evaluation.md").read_text()
    for folder in (UNSEEN, SAMPLE):
        both = Sample.read(folder)
        said = dict.fromkeys(both.episodes, frozenset({next(iter(LEAVES))}))
        assert beside_rules(both, said, "smollm2-135m") in text
