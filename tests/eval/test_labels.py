"""Labels of failures: how readers agree, how the rules meet what they say, and the sample that ships."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from agentspec.failures import LEAVES
from agentspec.types import Task
from eval.failures import replayed
from eval.labels import (
    SAMPLE,
    UNSEEN,
    Agreement,
    Sample,
    agreed,
    agreement,
    kappa,
    kappa_of,
    main,
    read_labels,
    summary,
)
from eval.transcripts import transcript

WORLDS = ("deliverybench", "minigrid", "alfred", "robothor")
A, B = "grounding/spatial/stuck", "grounding/spatial/distance"


def labels(**found: str) -> dict[str, frozenset[str]]:
    names = {"a": A, "b": B}
    return {episode: frozenset(names[letter] for letter in letters) for episode, letters in found.items()}


def test_agreement_by_hand() -> None:
    first, second = labels(one="a", two="ab", three="", four="b"), labels(one="a", two="a", three="", four="b")
    both, disputed = agreed(first, second)
    assert both == second and disputed == labels(one="", two="b", three="", four="")
    said = labels(one="", two="ab", three="a", four="b")
    found = agreement(both, said, disputed)
    # a: labelled in one and two, said of two and three. b: two is disputed; labelled in four, said of four.
    assert found[A] == Agreement(2, 2, 1) and (found[A].precision, found[A].recall) == (0.5, 0.5)
    assert found[B] == Agreement(1, 1, 1)
    assert found["parse/unstructured_memory"] == Agreement(0, 0, 0)
    assert found["parse/unstructured_memory"].precision is None is found["parse/unstructured_memory"].recall
    assert agreement(both, said)[B] == Agreement(1, 2, 1)


def test_kappa_by_hand() -> None:
    # Agreement 3 of 4; by chance (2 * 3 + 2 * 1) / 16: (.75 - .5) / (1 - .5).
    assert kappa(["x", "x", "y", "y"], ["x", "x", "y", "x"]) == pytest.approx(0.5)
    assert kappa([1, 0], [1, 0]) == 1 and math.isnan(kappa([0, 0], [0, 0]))
    with pytest.raises(ValueError, match="same items"):
        kappa(["x"], [])
    # Four episodes by two kinds: b of `two` is the one of eight pairs that differs; 4 and 3 of them are marked.
    first, second = labels(one="a", two="ab", three="", four="b"), labels(one="a", two="a", three="", four="b")
    chance = (4 * 3 + 4 * 5) / 64
    assert kappa_of(first, second, [A, B]) == pytest.approx((7 / 8 - chance) / (1 - chance))


def test_labels_are_read_and_checked(tmp_path: Path) -> None:
    path = tmp_path / "labels.jsonl"
    path.write_text(json.dumps({"episode": "001", "labels": [A]}) + "\n")
    assert read_labels(path) == read_labels(path, ["001"]) == {"001": {A}}
    with pytest.raises(ValueError, match="no labels for the episodes 002"):
        read_labels(path, ["001", "002"])
    for wrong, message in (
        ({"episode": "001", "labels": ["lazy"]}, "line 1: 'lazy' is none of"),
        ({"episode": "009", "labels": []}, "line 1: expected"),
        ({"episode": "001"}, "line 1: expected"),
        ({"episode": "001", "labels": [{}]}, "line 1: expected"),
    ):
        path.write_text(json.dumps(wrong) + "\n")
        with pytest.raises(ValueError, match=message):
            read_labels(path, ["001"])
    line = json.dumps({"episode": "001", "labels": [A]})
    path.write_text(line)  # no end of line
    assert read_labels(path) == {"001": {A}}
    path.write_text(f"{line}\n{line}\n")
    with pytest.raises(ValueError, match="line 2: episode 001 has been labelled above"):
        read_labels(path)


def test_a_transcript_shows_what_was_done_and_nothing_that_a_rule_found() -> None:
    pytest.importorskip("minigrid")
    level = {"level": "MiniGrid-Empty-6x6-v0", "max_steps": 4}
    episode = replayed(Task("minigrid", 0, level), ["FORWARD()"] * 3 + ["I give up"])
    text = transcript(episode)
    assert text.count("STEP ") == 4 and "DOES: I give up" in text and "ANSWER: went forward" in text
    assert "ANSWER: failed: 'I give up' is not an action" in text and text.endswith(
        "used up; success 0, efficiency 0, reward 0."
    )
    assert not any(leaf in text for leaf in LEAVES)
    rules = episode.transitions[0].input.instruction.splitlines()
    assert rules[0] in text and rules[0] not in transcript(episode, known=rules)
    assert "Cell in front" in text and text.count("Cell in front") > 1
    assert transcript(episode, left_out=["Cell in front"]).count("Cell in front") == text.count("Cell in front")
    courier = Task("deliverybench", 0, {"size": "tiny", "shift_hours": 1.0})
    long = replayed(courier, ["MOVE(-17m, 45.9m)", "WAIT(60)"])
    shown = (transcript(long, left_out=left_out).count("- junctions:") for left_out in ((), ["- junctions:"]))
    assert [*shown] == [2, 1]


@pytest.fixture(scope="module")
def sample() -> Sample:
    return Sample.read()


def test_the_sample_has_what_it_says(sample: Sample) -> None:
    worlds = {world: sum(t.task.env == world for t in sample.episodes.values()) for world in WORLDS}
    assert sum(worlds.values()) == len(sample.episodes) == 67 and min(worlds.values()) >= 8
    assert sum(who.startswith("model: ") for who in sample.sources.values()) == 16
    # Every kind was seen by both readers in some episode, and every episode can be judged without an agent.
    both, _ = agreed(sample.a, sample.b)
    assert {kind for kinds in both.values() for kind in kinds} == set(LEAVES)
    assert all(t.scorable and t.transitions and not t.calls for t in sample.episodes.values())


def test_precision_recall_and_kappa_of_the_rules(sample: Sample) -> None:
    """Recomputed from the trajectories and both readers' files; the documentation says the same."""
    rules = sample.rules()
    both, disputed = agreed(sample.a, sample.b)
    found = agreement(both, rules, disputed)
    whole = sum(found.values(), Agreement(0, 0, 0))
    # By another way: over pairs of episode and kind that are not disputed.
    pairs = [(e, kind) for e in sample.episodes for kind in LEAVES if kind not in disputed[e]]
    assert whole.labelled == sum(kind in both[e] for e, kind in pairs)
    assert whole.both == sum(kind in both[e] and kind in rules[e] for e, kind in pairs)
    assert whole.precision is not None and whole.recall is not None
    assert whole.precision >= 0.9 and whole.recall >= 0.85
    assert kappa_of(sample.a, sample.b) > 0.8 and kappa_of(rules, sample.a) > 0.8 < kappa_of(rules, sample.b)
    text = (Path(__file__).parents[2] / "docs/evaluation.md").read_text()
    assert summary(sample, rules) in text, "run python -m eval.labels and put what it prints into docs/evaluation.md"


def test_the_rules_hold_on_a_sample_that_they_were_not_mended_by() -> None:
    unseen, seen = Sample.read(UNSEEN), Sample.read(SAMPLE)
    episodes = [{t.to_json() for t in sample.episodes.values()} for sample in (unseen, seen)]
    assert len(episodes[0]) == 36 and not episodes[0] & episodes[1]
    rules = unseen.rules()
    both, disputed = agreed(unseen.a, unseen.b)
    whole = sum(agreement(both, rules, disputed).values(), Agreement(0, 0, 0))
    assert whole.precision is not None and whole.recall is not None
    assert whole.precision >= 0.85 and whole.recall >= 0.8
    text = (Path(__file__).parents[2] / "docs/evaluation.md").read_text()
    assert summary(unseen, rules) in text, "run python -m eval.labels eval/data/unseen_failures and put it there"


def test_the_command_prints_it_and_judges_other_answers(
    sample: Sample, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main([])
    assert capsys.readouterr().out.strip() == summary(sample, sample.rules())
    main(["--answers", str(SAMPLE / "labels_a.jsonl")])
    printed = capsys.readouterr().out
    assert "answers with a 1.00" in printed and printed.count("| 1.00 | 1.00 |") == len(LEAVES) + 1
