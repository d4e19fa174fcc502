"""LightMem: each stage by itself, then in order; sleep changes earlier facts by later ones."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.memory.lightmem.compression import WordCounts, boundaries, keep_surprising
from agentspec.registry import REGISTRY, SpecError
from tests.memory.bench import Bench, Rows
from tests.memory.recall_world import notes, succeeds

NAME = {"name": "lightmem", "repairs": 0}


def facts(*given: tuple[int, str]) -> dict:
    return {"facts": [{"source": source, "fact": text} for source, text in given]}


def texts(bench: Bench) -> list[str]:
    return [e.text for e in bench.memory.entries]


@given(st.lists(st.tuples(st.text("abc", min_size=1), st.floats(0, 9))), st.floats(0.01, 1))
def test_compression_keeps_exactly_its_share_in_order(pairs: list[tuple[str, float]], rate: float) -> None:
    words, surprisal = [w for w, _ in pairs], [s for _, s in pairs]
    kept = keep_surprising(words, surprisal, rate)
    assert len(kept) == (max(1, int(rate * len(words) + 1e-9)) if words else 0)
    left = iter(words)
    assert all(word in left for word in kept)  # a subsequence


def test_words_that_come_often_go_first() -> None:
    counts = WordCounts()
    counts.add(["battery", "50", "battery", "49", "battery", "48"])
    # battery was seen 3 times, 50 once, vault never: of 6 + 4 + 1 they have shares 4, 2 and 1.
    assert counts.surprisal(["Battery", "(50)", "vault"]) == pytest.approx([1.4594, 2.4594, 3.4594], abs=1e-4)
    assert keep_surprising(["battery", "50", "vault"], counts.surprisal(["battery", "50", "vault"]), 0.7) == [
        "50",
        "vault",
    ]
    small = WordCounts(most=2)
    small.add(["a", "a", "b", "c"])
    assert small.counts == {"a": 1}


def test_topics_begin_where_turns_are_unlike_and_the_threshold_rises_to_a_half() -> None:
    assert boundaries([0.9, 0.1, 0.9, 0.15]) == [2, 4]  # below 0.2 at once
    assert boundaries([0.9, 0.31, 0.9, 0.33]) == [2, 4]  # at 0.35
    assert boundaries([0.9, 0.31, 0.9, 0.36]) == [2]  # at 0.35, and no further
    assert boundaries([0.9, 0.49]) == [2] and boundaries([0.9, 0.5]) == [] and boundaries([]) == []


def test_a_shift_of_topic_cuts_the_buffer_and_the_last_topic_stays() -> None:
    world = Rows({"mill": [1.0, 0.0], "port": [0.0, 1.0]})
    bench = Bench({**NAME, "rate": 1.0, "sensory_tokens": 120, "stm_tokens": 10_000}, embedder=world)
    for state in ("the mill one", "the mill two", "the port one"):  # 50 bytes each
        bench.step(state)
    memory = bench.memory
    assert [[s.text.splitlines()[0] for s in steps] for _, steps in memory.topics] == [
        ["State: the mill one", "State: the mill two"]
    ]
    assert [s.text.splitlines()[0] for s in memory.sensory] == ["State: the port one"] and bench.asked == []


def test_short_term_memory_becomes_facts_exactly_when_it_would_be_too_full() -> None:
    # Each step is a buffer of its own: "State: s\nAction: WAIT()\nResult: done" has 8 + 1 + 14 + 1 + 12 = 36 bytes.
    # Two make 72: allowed under 72, asked about before the third; under 71 before the second.
    for most, asked_at in ((72, 3), (71, 2)):
        memory = {**NAME, "rate": 1.0, "sensory_tokens": 1, "stm_tokens": most}
        bench = Bench(memory, {"extract": facts((0, "A fact."))})
        for _ in range(asked_at):
            assert bench.asked == []
            bench.step("s")
        assert bench.purposes() == ["extract"] and texts(bench) == ["A fact."]
        assert sum(len(steps) for _, steps in bench.memory.topics) == 1


def small(**more: object) -> dict:
    """A memory that asks about each step when the next one comes."""
    return {**NAME, "rate": 1.0, "sensory_tokens": 1, "stm_tokens": 1, **more}


def test_facts_have_the_time_and_topic_of_their_source() -> None:
    memory = {**NAME, "rate": 1.0, "sensory_tokens": 1, "stm_tokens": 72}
    bench = Bench(memory, {"extract": facts((1, "Second."), (0, "First."), (9, "Unknown."), (0, " "))})
    for _ in range(3):
        bench.step("s")
    assert [(e.text, e.time.step, e.data["topic"]) for e in bench.memory.entries] == [
        ("Second.", 1, 1),
        ("First.", 0, 0),
        ("Unknown.", 1, 1),
    ]
    prompt = bench.prompt("extract")
    assert "Topic 1:\n\n[0] step 1\nState: s" in prompt and "Topic 2:\n\n[1] step 2\n" in prompt


def test_an_extraction_that_cannot_be_read_leaves_the_topics_for_the_next_one() -> None:
    bench = Bench(small(stm_tokens=100), {"extract": ["?", facts((0, "A fact."))]})
    for i in range(3):  # 36 bytes each: the third is one too many
        bench.step("abc"[i])
    assert texts(bench) == [] and bench.problems() == {"malformed": 1} and len(bench.memory.topics) == 3
    bench.step("d")
    assert all(f"State: {s}" in bench.prompt("extract") for s in "abc") and texts(bench) == ["A fact."]


def sleeping(
    *verdicts: dict, rows: dict | None = None, said: tuple[str, ...] = ("Mill open.", "Port.", "Mill shut.")
) -> Bench:
    """Three facts of one episode, then the sleep before the next."""
    world = Rows(rows or {"Mill open": [1.0, 0.0], "Mill shut": [0.9, 0.43589], "Port": [0.0, 1.0]})
    bench = Bench(
        small(), {"extract": [facts((0, s)) for s in said], "sleep": list(verdicts)}, embedder=world, scope="run"
    )
    for _ in said:
        bench.step("s")
    bench.end()
    assert "sleep" not in bench.purposes()
    bench.recall("s")
    return bench


def test_sleep_shows_an_earlier_fact_the_later_ones_like_it_and_updates_it() -> None:
    # cos(open, shut) = 0.9 >= 0.8; the port is like neither (0.44 and 0). Only the first has a later one: one call.
    bench = sleeping({"action": "update", "text": "Mill shut since step 3."})
    assert bench.purposes() == ["extract"] * 3 + ["sleep"]
    assert texts(bench) == ["Mill shut since step 3.", "Port.", "Mill shut."]
    prompt = bench.prompt("sleep")
    assert "- Mill open. [episode 1, step 1]\n\nLater notes" in prompt and prompt.endswith(
        "- Mill shut. [episode 1, step 3]"
    )


def test_sleep_deletes_and_ignores_and_does_not_ask_twice() -> None:
    assert texts(sleeping({"action": "delete"})) == ["Port.", "Mill shut."]
    bench = sleeping({"action": "ignore", "text": ""})
    assert texts(bench) == ["Mill open.", "Port.", "Mill shut."]
    bench.end()
    bench.recall("s")
    assert bench.purposes().count("sleep") == 1  # nothing later has come
    malformed = sleeping({"action": "burn"})
    assert len(texts(malformed)) == 3 and malformed.problems() == {"malformed": 1}


def test_a_fact_is_never_changed_by_an_earlier_one() -> None:
    # All three alike: the last has no later one, the first two have; asked newest first.
    rows = {"Mill": [1.0, 0.0]}
    bench = sleeping({"action": "ignore"}, rows=rows, said=("Mill a.", "Mill b.", "Mill c."))
    asked = [r.messages[-1].text for r in bench.asked if r.tag.purpose == "sleep"]
    assert ["Mill b." in a.partition("Later notes")[0] for a in asked] == [True, False]
    assert "Mill a." not in asked[0] and "Mill b." in asked[1] and "Mill c." in asked[1]


def test_words_may_be_scored_by_the_model() -> None:
    assert REGISTRY.get("memory", "lightmem").needs_with({}) == ("embedder",)
    assert REGISTRY.get("memory", "lightmem").needs_with({"compressor": "model"}) == ("embedder", "score")
    # The scripted model's log-probability is minus the number of bytes: long words surprise. Of 4 words 2 are kept.
    bench = Bench({**NAME, "compressor": "model", "rate": 0.5})
    bench.step("a lighthouse is northwards")
    assert bench.memory.sensory[0].text.startswith("State: lighthouse northwards\nAction: WAIT()")


def test_parameters_out_of_range_are_refused() -> None:
    for params in ({"rate": 0.0}, {"rate": 1.5}, {"compressor": "zip"}, {"sensory_tokens": 0}):
        with pytest.raises(SpecError):
            Bench({"name": "lightmem", **params})


def test_lightmem_recalls_what_a_short_window_has_lost() -> None:
    def extract(request) -> str:
        return json.dumps(facts(*((0, note) for note in notes(request))))

    memory = {"name": "lightmem", "preset": "rl", "rate": 1.0, "sensory_tokens": 60, "stm_tokens": 120}
    assert not succeeds({"name": "base", "window": 5})
    assert succeeds(memory, curate={"extract": extract})
    assert succeeds(memory, curate={"extract": extract}, scope="run")


def test_a_compressed_state_keeps_numbers_with_their_names_and_its_paragraphs() -> None:
    bench = Bench({**NAME, "rate": 0.6, "sensory_tokens": 10_000, "step_tokens": 400})
    for minute in range(4):
        orders = f"order 2: ready in {30 - minute} s, restaurant 4 (99.8m, -223.7m) 183m, 7 min 57 s left"
        bench.step(f"{minute} min on the clock, energy 9{minute}%\n\n{orders}\n\nnear: car_rental 1 (22.3m, -128.9m)")
    told = bench.memory.sensory[-1].text
    assert "restaurant 4" in told and "(99.8m, -223.7m)" in told and " | " in told
    words = told.partition("\n")[0].split()
    for i, word in enumerate(words):
        assert word != "min" or words[i - 1].isdigit()
