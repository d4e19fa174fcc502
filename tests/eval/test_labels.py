"""Labels of failures: how readers agree, how the rules meet what they say, and the sample that ships."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from agentspec.failures import LEAVES
from agentspec.types import Task
from eval.failures import replayed
from eval.labels import Agreement, agreed, agreement, kappa, kappa_of, read_labels
from eval.transcripts import transcript

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
    ):
        path.write_text(json.dumps(wrong) + "\n")
        with pytest.raises(ValueError, match=message):
            read_labels(path, ["001"])


def test_a_transcript_shows_what_was_done_and_nothing_that_a_rule_found() -> None:
    pytest.importorskip("minigrid")
    level = {"level": "MiniGrid-Empty-6x6-v0", "max_steps": 4}
    episode = replayed(Task("minigrid", 0, level), ["FORWARD()"] * 3 + ["I give up"])
    text = transcript(episode)
    assert text.count("STEP ") == 4 and "DOES: I give up" in text and "ANSWER: went forward" in text
    assert "ANSWER: failed: 'I give up' is not an action" in text and text.endswith("used up; success 0.")
    assert not any(leaf in text for leaf in LEAVES)
    rules = episode.transitions[0].input.instruction.splitlines()
    assert rules[0] in text and rules[0] not in transcript(episode, known=rules)
    assert "Cell in front" in text and text.count("Cell in front") > 1
    assert transcript(episode, left_out=["Cell in front"]).count("Cell in front") == text.count("Cell in front")
    courier = Task("deliverybench", 0, {"size": "tiny", "shift_hours": 1.0})
    long = replayed(courier, ["MOVE(-17m, 45.9m)", "WAIT(60)"])
    shown = (transcript(long, left_out=left_out).count("- junctions:") for left_out in ((), ["- junctions:"]))
    assert [*shown] == [2, 1]
