"""OpenClaw: files that stay in their folder, hybrid search in numbers, one flush per cut, dreaming and its guard."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.context import Context
from agentspec.memory.openclaw import Edit, OpenClaw
from agentspec.memory.openclaw.files import FileTree, Skill, checked_path, rules_of, rules_text, skills_in, slug
from agentspec.memory.openclaw.search import Chunk, decay, dream_score, hybrid, kept_share, signals
from agentspec.registry import SpecError
from agentspec.retrieval import Lexical, VectorIndex
from agentspec.tokens import estimate_tokens
from tests.memory.by_hand import TASK, Asked, episode, learn, recall, services, step
from tests.memory.recall_world import succeeds


def edits(*changes: dict) -> str:
    return json.dumps({"edits": list(changes)})


NONE = edits()


def claw(script=None, *, context: Context | None = None, **params) -> OpenClaw:
    return OpenClaw(services(script or Asked(learn=NONE), context=context), **params)


def test_edits_change_what_they_name_and_nothing_else() -> None:
    memory = claw()
    for edit in (
        Edit("add", "Hot food", "Deliver within 5 min."),
        Edit("add", "Battery", "Charge below 20 %."),
        Edit("update", "Hot  food", "Deliver within\n4 min."),
        Edit("remove", "never written"),
        Edit("add", "", "no name"),
        Edit("add", "no text", " "),
    ):
        memory.workspace.apply(edit)
    assert memory.workspace.rules == {"Battery": "Charge below 20 %.", "Hot food": "Deliver within 4 min."}
    memory.workspace.apply(Edit("remove", "Battery"))
    assert recall(memory, "") == ["- **Hot food**: Deliver within 4 min."]


def test_steps_are_learnt_from_every_so_often() -> None:
    asked = Asked(
        learn=[edits({"op": "add", "name": "a", "text": "Go."}), edits({"op": "update", "name": "a", "text": "No."})]
    )
    memory = claw(asked, every=2)
    learn(memory, *(step(i, f"room {i}", f"GO({i})") for i in range(5)))
    assert asked.purposes == ["learn", "learn"] and memory.workspace.rules == {"a": "No."}
    assert "- a: Go." in asked.prompt(1) and "GO(3)" in asked.prompt(1) and "GO(4)" not in asked.prompt(1)


@pytest.mark.parametrize("answer", ["", "prose", '{"edits": [{"op": "burn", "name": "a"}]}', '{"edits": "x"}'])
def test_a_bad_answer_edits_nothing_and_is_counted(answer: str) -> None:
    memory = claw(Asked(learn=answer), every=1)
    memory.workspace.apply(Edit("add", "a", "Stay."))
    learn(memory, step(0, "x"))
    assert memory.workspace.rules == {"a": "Stay."}
    assert memory.services.llm.recorder.problems["memory.m", "malformed"] == 1


def test_memory_md_keeps_its_budget_and_drops_what_was_written_longest_ago() -> None:
    memory = claw(memory_tokens=20)
    for name in "abcd":
        memory.workspace.apply(Edit("add", name, "word " * 4))
    # A line has 2 + 5 + 2 + 19 = 28 characters with its break about 29, the heading 10: 2 lines are 68 characters, 18
    # tokens; 3 are 97, 25 tokens.
    assert list(memory.workspace.rules) == ["c", "d"] and estimate_tokens(rules_text(memory.workspace.rules)) <= 20
    memory.workspace.apply(Edit("add", "long", "word " * 100))
    assert list(memory.workspace.rules) == ["long"] and memory.workspace.rules["long"].endswith(" ...")


@given(st.dictionaries(st.text(), st.text(), max_size=4))
def test_memory_md_reads_as_it_was_written(given_rules: dict[str, str]) -> None:
    memory = claw()
    for name, text in given_rules.items():
        memory.workspace.apply(Edit("add", name, text))
    assert rules_of(rules_text(memory.workspace.rules)) == memory.workspace.rules


def test_a_skill_is_listed_and_read_when_it_fits() -> None:
    memory = claw(skill_least=0.2)
    memory.workspace.apply(Edit("skill", "Charge the scooter", "1. MOVE\n2. CHARGE", "battery low scooter"))
    memory.workspace.apply(Edit("skill", "Cool a bag", "1. BUY ice", "melting ice cream"))
    shown = recall(memory, "the scooter battery is low")
    assert shown[0] == "Skill Charge the scooter (battery low scooter):\n1. MOVE\n2. CHARGE"
    assert shown[1] == "Other skills: Cool a bag (melting ice cream)"
    assert recall(memory, "rain") == [
        "Other skills: Charge the scooter (battery low scooter); Cool a bag (melting ice cream)"
    ]


def test_what_was_learnt_takes_precedence_over_what_was_given(tmp_path: Path) -> None:
    (tmp_path / "climb").mkdir()
    (tmp_path / "climb" / "SKILL.md").write_text(
        "---\nname: Climb\ndescription: stairs\n---\nGo up.\n", encoding="utf-8"
    )
    memory = claw(skills=str(tmp_path), skill_least=0.0)
    assert recall(memory, "stairs") == ["Skill Climb (stairs):\nGo up."]
    memory.workspace.apply(Edit("skill", "climb", "Take the lift.", "stairs"))
    assert recall(memory, "stairs") == ["Skill climb (stairs):\nTake the lift."]
    assert "Go up." not in memory.snapshot().decode()
    (tmp_path / "climb" / "SKILL.md").write_text("no front matter", encoding="utf-8")
    with pytest.raises(ValueError, match="climb"):
        skills_in(tmp_path)
    with pytest.raises(ValueError, match="no folder"):
        claw(skills=str(tmp_path / "nowhere"))


def test_hybrid_search_in_numbers() -> None:
    class Axes:
        dim = 2

        def embed(self, texts):
            import numpy as np

            return np.array([[1.0, 0.0] if "red" in t else [0.6, 0.8] for t in texts], dtype=np.float32)

    vectors, words = VectorIndex(Axes()), Lexical()
    for key, text in ((1, "red key"), (2, "blue key"), (3, "blue door")):
        vectors.put(key, text)
        words.put(key, text)
    bm25 = dict(words.search("red door", 9))
    # Cosines with "red ...": 1, .6, .6; words hit 1 and 3. 0.7 cos + 0.3 b / (1 + b).
    expected = {1: 0.7 + 0.3 * bm25[1] / (1 + bm25[1]), 2: 0.42, 3: 0.42 + 0.3 * bm25[3] / (1 + bm25[3])}
    assert dict(hybrid(vectors, words, "red door", 3)) == pytest.approx(expected, abs=1e-6)
    assert [key for key, _ in hybrid(vectors, words, "red door", 2)] == [1, 3]
    # Diverse: after 1 (similarity .6 to both) the order of 2 and 3 is by score; each is chosen once.
    assert sorted(key for key, _ in hybrid(vectors, words, "red door", 3, diverse=True)) == [1, 2, 3]


def test_decay_halves_at_the_half_life() -> None:
    assert [decay(0, 30), decay(30, 30), decay(60, 30), decay(60, 0)] == [1.0, 0.5, 0.25, 1.0]


def test_the_dreaming_score_in_numbers() -> None:
    recalled = {"recalls": 4, "relevance": 2.0, "queries": ("a", "b", "c"), "episodes": (0, 1)}
    chunk = Chunk("order 17 pays $5.40 at restaurant 5", episode=0, step=3, **recalled)
    # relevance 2/4; frequency ln 5 / ln 11 = .6712; diversity 3/5; age 1 of half-life 1: .5; 2/3 of 3 episodes;
    # rich terms: 17, 5.40, restaurant, 5 = 4 of 6.
    assert signals(chunk, 1, 1.0) == pytest.approx(
        {
            "relevance": 0.5,
            "frequency": 0.67117,
            "diversity": 0.6,
            "recency": 0.5,
            "consolidation": 2 / 3,
            "richness": 4 / 6,
        },
        abs=1e-4,
    )
    # .3*.5 + .24*.67117 + .15*.6 + .15*.5 + .1*.66667 + .06*.66667 = .15 + .16108 + .09 + .075 + .06667 + .04
    assert dream_score(chunk, 1, 1.0) == pytest.approx(0.58275, abs=1e-4)


def conversation(window: int, turns: int, size: int) -> Context:
    """A conversation of `turns` steps, each of `size` characters of observation; tokens are characters."""
    context = Context("conversation", count_tokens=len, window=window)
    for _ in range(turns):
        context.prompt("", "x" * size)
        context.close(("a",))
    return context


@pytest.mark.parametrize(("window", "flushed", "cut"), [(1024, 0, 0), (1023, 1, 0), (1002, 1, 0), (1001, 1, 1)])
def test_the_flush_comes_at_its_threshold_and_the_cut_at_its_own(window: int, flushed: int, cut: int) -> None:
    # 8 steps of 100 + 1 and one of 92 + 1 characters: 901 tokens. 0.88 * 1023 = 900.2 is exceeded, 0.88 * 1024 = 901.1
    # is not; 0.9 * 1001 = 900.9 is exceeded, 0.9 * 1002 = 901.8 is not.
    asked = Asked(learn=NONE, flush="- Order 3 is open.\n- Battery 20 %.")
    context = conversation(window, 8, 100)
    context.prompt("", "x" * 92)
    context.close(("a",))
    assert context.tokens() == 901
    memory = claw(asked, context=context, every=100, keep=2)
    learn(memory, step(8, "x"))
    assert asked.purposes == ["flush"] * flushed and memory.metrics()["cuts"] == cut
    assert context.steps == (2 if cut else 9)
    if flushed:
        assert recall(memory, "x") == ["Note of step 9: Order 3 is open.", "Note of step 9: Battery 20 %."]
    before = len(asked.requests)
    learn(memory, step(9, "x"))
    assert len(asked.requests) == before, "one flush per cut"


def test_nothing_to_keep_is_no_note() -> None:
    memory = claw(Asked(learn=NONE, flush="NO_REPLY"), context=conversation(100, 5, 40), every=100, keep=2)
    learn(memory, step(4, "x"))
    assert [c.text for c in memory.log.values() if c.note] == [] and memory.metrics()["cuts"] == 1


def dreamer(answer: str) -> OpenClaw:
    memory = claw(
        Asked(learn=NONE, dream=answer), least_score=0.1, least_recalls=2, least_queries=2, recent=0, least=0.0
    )
    for name in "abcd":
        memory.workspace.apply(Edit("add", name, f"Rule {name}."))
    memory.begin_episode(TASK)
    learn(memory, step(0, "a red key in room 5"))
    recall(memory, "red key")
    recall(memory, "the key of room 5")
    asyncio.run(memory.end_episode(episode(step(0, "a red key in room 5"))))
    return memory


def rewritten(names: str) -> str:
    return json.dumps({"rules": [{"name": n, "text": f"New {n}."} for n in names]})


def test_dreaming_promotes_and_refuses_a_rewrite_that_loses_too_much() -> None:
    # Of 4 rules, 3 kept is a loss of 25 %: allowed. 2 kept is 50 %: refused.
    memory = dreamer(rewritten("abce"))
    assert memory.workspace.rules == {n: f"New {n}." for n in "abce"} and memory.metrics()["promoted"] == 1
    asyncio.run(memory._dream())
    assert memory.metrics()["promoted"] == 1, "what is promoted is not promoted again"
    memory = dreamer(rewritten("abef"))
    assert memory.workspace.rules == {n: f"Rule {n}." for n in "abcd"}
    assert (memory.metrics()["promoted"], memory.metrics()["rewrites_refused"]) == (0, 1)
    assert [kept_share({"a": "", "b": ""}, {"a": ""}), kept_share({}, {})] == [0.5, 1.0]


def test_without_a_later_episode_nothing_is_written_at_the_end() -> None:
    asked = Asked(learn=NONE)
    memory = claw(asked, every=5)
    memory.services.carried = False
    learn(memory, step(0, "a"))
    asyncio.run(memory.end_episode(episode(step(0, "a"))))
    assert not asked.requests


@pytest.mark.parametrize("path", ["", "/etc/passwd", "../x", "a/../../x", "C:\\x", "a\\b", "a\x00b", "a:b", "x" * 300])
def test_paths_never_leave_the_workspace(path: str) -> None:
    with pytest.raises(ValueError, match="no path of a workspace"):
        checked_path(path)


def test_exports_stay_in_their_folder(tmp_path: Path) -> None:
    memory = claw(every=9)
    memory.workspace.apply(Edit("skill", "../../evil name", "Do it.", "never"))
    memory.workspace.apply(Edit("add", "a", "Go."))
    learn(memory, step(0, "room"))
    target = tmp_path / "out"
    written = sorted(str(p.relative_to(target)) for p in memory.files().export(target))
    assert written == ["MEMORY.md", "memory/episode-0001.md", "skills/evil-name/SKILL.md"]
    assert "- step 1: WAIT() -> done | in: room" in (target / "memory/episode-0001.md").read_text(encoding="utf-8")
    assert Skill.parse((target / "skills/evil-name/SKILL.md").read_text(encoding="utf-8")).body == "Do it."
    assert "== MEMORY.md" in memory.describe()
    (tmp_path / "elsewhere").mkdir()
    trap = tmp_path / "trap"
    trap.mkdir()
    (trap / "memory").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match="leads out of"):
        memory.files().export(trap)
    assert not list((tmp_path / "elsewhere").iterdir()) and not (trap / "MEMORY.md").exists()
    assert len(FileTree({"a.md": "x"})) == 1 and slug("***") == "unnamed"


def test_the_log_is_bounded_and_snapshots_are_exact() -> None:
    memory = claw(max_log=3, every=2, half_life=2.0)
    memory.workspace.apply(Edit("skill", "climb", "Up.", "stairs"))
    learn(memory, *(step(i, f"room {i}") for i in range(5)))
    recall(memory, "room 1")
    assert [c.step for c in memory.log.values()] == [2, 3, 4]
    other = claw(max_log=3, every=2, half_life=2.0)
    other.services.clock.step = memory.services.clock.step
    other.restore(memory.snapshot())
    assert other.snapshot() == memory.snapshot() and recall(other, "room 1") == recall(memory, "room 1")
    assert other.snapshot() == memory.snapshot()


def test_nothing_is_shown_twice() -> None:
    memory = claw(every=100, search=6, recent=2, least=0.0)
    learn(memory, *(step(i, f"room {i}") for i in range(11)))
    shown = recall(memory, "room 5")
    # The newest two, and of the nine others a third.
    assert len(shown) == len(set(shown)) == 5


def test_search_shows_what_scores_enough() -> None:
    memory = claw(every=100, search=6, recent=2, least=0.99)
    learn(memory, *(step(i, f"room {i}") for i in range(11)))
    assert len(recall(memory, "room 5")) == 2


def test_bad_parameters_are_refused() -> None:
    for bad in ({"every": 0}, {"reserve": 1.0}, {"max_loss": 2.0}, {"preset": "x"}):
        with pytest.raises(SpecError, match="openclaw"):
            claw(**bad)


@pytest.mark.parametrize("layout", ["snapshot", "conversation"])
@pytest.mark.parametrize("scope", ["episode", "run"])
def test_a_fact_seen_long_ago_decides(scope: str, layout: str) -> None:
    assert not succeeds({"name": "base", "window": 5}, scope=scope, layout=layout)
    for preset in ("paper", "rl"):
        assert succeeds({"name": "openclaw", "preset": preset}, scope=scope, layout=layout)


def test_a_rewrite_has_room_for_all_rules_there_may_be() -> None:
    """A memory as full as it may be: its rewrite, in JSON, fits into the answer."""
    rules = {f"rule number {i}": "When the energy is below 20 %, rest before the next order." for i in range(40)}
    asked = Asked(dream="{}")
    memory = claw(asked, preset="rl", least_score=0.1, least_recalls=1, least_queries=1, recent=0)
    memory.workspace.write(rules)
    memory._append("The bus leaves at 12:40.", 0)
    memory.log.recalled(0, 0.9, "bus", 0)
    asyncio.run(memory._dream())
    whole = json.dumps({"rules": [{"name": name, "text": text} for name, text in memory.workspace.rules.items()]})
    assert len(memory.workspace.rules) > 10
    assert asked.requests[-1].sampling.max_tokens >= estimate_tokens(whole) > memory.answer_tokens
