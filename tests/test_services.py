"""What a module is given: asking for typed answers, time, ids, and what is counted when something goes wrong."""

from __future__ import annotations

import asyncio
import contextlib
import random
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agentspec.context import Context
from agentspec.llm.base import Request
from agentspec.llm.recorder import Budget, ModuleLLM, Recorder
from agentspec.llm.scripted import ScriptedLLM
from agentspec.services import Answer, Services, StepClock, Time
from agentspec.state import dump_state, load_state
from agentspec.structured import ParseError, describe, json_of
from agentspec.types import Sampling


@dataclass(frozen=True)
class Note:
    text: str
    weight: float
    tags: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Share:
    part: float

    def __post_init__(self) -> None:
        if not 0 <= self.part <= 1:
            raise ValueError(f"part must lie between 0 and 1, not {self.part}")


NOTE = json_of(Note)


def services(*answers: str, max_context: int = 1_000_000, **budget: Any) -> Services:
    llm = ScriptedLLM(list(answers), max_context=max_context)
    sampling = Sampling(stop=("\n",), choices=("GO()", "STOP()"))  # the action's: they must not apply
    recorder = Recorder(llm, episode="e", seed=0, sampling=sampling, budget=Budget(**budget))
    return Services(ModuleLLM(recorder, "memory.m"), Context(), StepClock(), random.Random(0))


def ask(given: Services, parse: Any = None, max_tokens: int = 200, **more: Any) -> Answer[Any]:
    return asyncio.run(given.ask("note", "What is worth noting?", max_tokens, parse, **more))


def problems(given: Services) -> dict[str, int]:
    return {problem: n for (_, problem), n in given.llm.recorder.problems.items()}


@pytest.mark.parametrize(
    "text",
    [
        '{"text": "hot food", "weight": 2}',
        'Here it is:\n```json\n{"text": "hot food", "weight": 2.0, "tags": []}\n```\nGood luck!',
        '<think>{"text": "no", "weight": 0}</think>{"text": "hot food", "weight": 2, "more": 1}',
        'a prompt may open it: {"text": "no", "weight": 0}</think>{"text": "hot food", "weight": 2}',
        '[THINK]{"text": "no", "weight": 0}[/THINK]{"text": "hot food", "weight": 2}',
        '◁think▷{"text": "no", "weight": 0}◁/think▷{"text": "hot food", "weight": 2}',
        '<think><think>a</think>{"text": "no", "weight": 0}</think>{"text": "hot food", "weight": 2}',
        '<|channel|>analysis<|message|>{"text": "no", "weight": 0}<|end|><|start|>assistant<|channel|>final<|message|>'
        '{"text": "hot food", "weight": 2}',
        'As in {the rules}, [see above]: {"text": "hot food", "weight": 2} and so on {"text": "b", "weight": 1}',
    ],
)
def test_json_is_found_in_what_is_written_around_it(text: str) -> None:
    assert NOTE(text) == Note("hot food", 2.0)


@pytest.mark.parametrize(
    ("schema", "text", "problem"),
    [
        (Share, '{"part": 2}', "part must lie between 0 and 1"),
        (Note, "Nothing to say.", "there is no JSON in it"),
        (Note, '{"text": "a"}', "the answer lacks 'weight'"),
        (Note, '{"text": 3, "weight": 1}', "'text' must be string, not 3"),
        (Note, '{"text": "a", "weight": true}', "'weight' must be number, not true"),
        (Note, '{"text": "a", "weight": 1, "tags": ["x", 1]}', "item 2 of 'tags' must be string, not 1"),
        (Note, '[{"text": "a"}]', "the answer must be"),
        ({"n": int}, '{"n": 1.5}', "'n' must be whole number"),
        ({"n": int | None}, '{"n": "x"}', "'n' must be whole number or null"),
        ({"op": Literal["ADD", "NONE"]}, '{"op": "DROP"}', '\'op\' must be "ADD" or "NONE"'),
        ({"d": dict[str, int]}, '{"d": {"a": []}}', "'a' of 'd' must be whole number"),
        (list[Note], "[" * 3000, "there is no JSON in it"),
    ],
)
def test_what_does_not_fit_says_why(schema: Any, text: str, problem: str) -> None:
    with pytest.raises(ParseError) as caught:
        json_of(schema)(text)
    assert problem in str(caught.value)


@given(st.one_of(st.text(), st.text('{}[]",:\\\\u0d8 tnf19eE+-"', max_size=80)))
@settings(deadline=None, max_examples=300)
def test_no_text_raises_anything_but_a_parse_error(text: str) -> None:
    for schema in (Note, list[Any], {"a": dict[str, float]}, dict[str, Any]):
        with contextlib.suppress(ParseError):
            load_state(dump_state(json_of(schema)(text) if schema is not Note else str(json_of(schema)(text))))


def test_what_no_file_or_prompt_can_hold_is_replaced_or_refused() -> None:
    # Half of a surrogate pair, a line break inside a string, numbers that are none, and depth without end.
    assert json_of({"text": str})('{"text": "a\\ud800b\nc"}') == {"text": "a?b\nc"}
    for number in ("NaN", "Infinity", "1e999", "1" * 400):
        with pytest.raises(ParseError, match="'n' must be number"):
            json_of({"n": float})(f'{{"n": {number}}}')
    with pytest.raises(ParseError, match="'n' must be whole number"):
        json_of({"n": int})(f'{{"n": {2**63}}}')
    for text in ("[" * 900 + "]" * 900, '{"a":' * 100_000, "[" * 900 + '"\\ud800"' + "]" * 900):
        with pytest.raises(ParseError):
            json_of({"a": int})(text)


def test_whatever_a_reader_raises_the_text_is_to_blame() -> None:
    import json

    given = services('{"steps": 3}')
    answer = ask(given, lambda text: [s.strip() for s in json.loads(text)["steps"]])  # a TypeError: no list
    assert answer.value is None and answer.problem == "malformed" and problems(given) == {"malformed": 1}


def test_types_are_read_as_the_schema_has_them() -> None:
    parse = json_of({"a": tuple[int, ...], "b": Any, "c": Literal[1, "x"], "d": dict[str, Note], "e": None | str})
    value = parse('{"a": [1, 2], "b": {"q": []}, "c": 1, "d": {"k": {"text": "t", "weight": 1}}, "e": null}')
    assert value == {"a": (1, 2), "b": {"q": []}, "c": 1, "d": {"k": Note("t", 1.0)}, "e": None}
    assert json_of(list[int])("I count [1, 2, 3].") == [1, 2, 3]
    assert describe(Note) == '{"text": string, "weight": number, "tags": [string, ...]}'


def test_an_answer_is_free_of_the_actions_constraints_and_typed() -> None:
    given = services('Line one\n{"text": "a", "weight": 1}')
    answer = ask(given, NOTE)
    assert answer.value == Note("a", 1.0) and answer.problem == "" and problems(given) == {}
    (call,) = given.llm.recorder.calls
    assert call.sampling.stop == () and call.sampling.choices == () and call.tag.path == "memory.m/note"


def test_thoughts_are_no_part_of_an_answer_in_words() -> None:
    """In the blocks of every family of models, and where the room ended within one."""
    for answer in ("<think>a lot</think>Rest.", "[THINK]a lot[/THINK]Rest.", "a lot</think>Rest.", "Rest.<|im_end|>"):
        assert ask(services(answer)).value == "Rest."
    assert ask(services("[THINK]a lot, and no end")).problem == "malformed"


def test_one_repair_with_the_reason() -> None:
    asked: list[Request] = []

    def script(request: Request) -> str:
        asked.append(request)
        return '{"text": "a"}' if request.id == 0 else '{"text": "a", "weight": 1}'

    given = services("x")
    given.llm.recorder.llm = ScriptedLLM(script)
    answer = ask(given, NOTE)
    assert answer.value == Note("a", 1.0) and answer.problem == "" and problems(given) == {"repaired": 1}
    assert "lacks 'weight'" in asked[1].messages[-1].text and describe(Note) in asked[1].messages[-1].text
    assert asked[1].messages[-2].text == '{"text": "a"}' and asked[1].tag.branch == "repair"


def test_what_cannot_be_repaired_is_a_counted_problem() -> None:
    given = services("No.")
    answer = ask(given, NOTE)
    assert answer.value is None and answer.problem == "malformed" and answer.text == "No."
    assert len(given.llm.recorder.calls) == 2 and problems(given) == {"unrepaired": 1, "malformed": 1}
    given = services("No.")
    assert ask(given, json_of(Note, repairs=0)).problem == "malformed" and len(given.llm.recorder.calls) == 1
    given = services("seven")
    assert ask(given, int).problem == "malformed" and len(given.llm.recorder.calls) == 1
    assert ask(services("7"), int).value == 7


def test_credit_does_not_depend_on_whether_it_parsed() -> None:
    given = services("No.")
    ask(given, NOTE, credit="executed")
    assert [c.completions[0].credit for c in given.llm.recorder.calls] == ["executed", "executed"]


def test_too_long_is_a_problem_and_no_exception() -> None:
    given = services('{"text": "a", "weight": 1}', max_context=100)
    assert ask(given, NOTE).problem == "overflow" and given.llm.recorder.calls == []
    given = services("a long story")
    answer = ask(given, max_tokens=6)
    assert (answer.value, answer.problem) == ("a long", "truncated") and problems(given) == {"truncated": 1}
    given = services("a long story")
    assert ask(given, json_of(Note, repairs=0), max_tokens=6).problem == "truncated"
    given = services("<think>for ever")
    assert ask(given).value is None and problems(given) == {"malformed": 1}


def test_a_budget_that_allows_no_call_is_a_problem() -> None:
    given = services("No.", calls=1)
    answer = ask(given, NOTE)  # the repair is not allowed any more
    assert answer.problem == "malformed" and answer.text == "No."
    assert ask(given).problem == "budget" and ask(given).call is None
    assert problems(given) == {"unrepaired": 1, "malformed": 1, "budget": 2}


def test_time_and_ids_go_on_over_the_episodes_of_a_run() -> None:
    clock = StepClock()
    assert [clock.new_id("memory.a"), clock.new_id("memory.a"), clock.new_id("memory.b")] == [0, 1, 0]
    clock.step = 5
    assert clock.time == Time(0, 5, 5)
    after = StepClock()
    after.resume(clock.carry())
    assert after.time == Time(1, 0, 5) and [after.new_id("memory.a"), after.new_id("memory.b")] == [2, 1]
    clock.new_id("memory.a")  # a fork does not see the other's
    assert after.new_id("memory.a") == 3


@pytest.mark.parametrize(("scope", "carried"), [("episode", False), ("run", True)])
def test_a_module_knows_whether_its_memory_is_carried_on(scope: str, carried: bool) -> None:
    from agentspec.spec import AgentSpec

    recorder = Recorder(ScriptedLLM([""]), episode="e", seed=0)
    agent = AgentSpec.from_data({"memory": "base", "scope": scope}).build(recorder)
    assert {s.carried for s in agent.services} == {carried}


NOTES = json_of({"notes": list[Note]}, whole=False)
TWO, ONE_BAD = '{"notes": [%s]}', '{"text": "b", "weight": "heavy"}'
GOOD = '{"text": "a", "weight": 1.0}'


def test_what_fits_of_a_list_is_read_where_the_parser_allows_it() -> None:
    answer = TWO % f"{GOOD}, {ONE_BAD}, 7"
    module = services(answer)
    found = ask(module, json_of({"notes": list[Note]}, repairs=0, whole=False))
    assert found.value == {"notes": [Note("a", 1.0)]} and found.problem == "malformed"
    assert problems(module) == {"malformed": 1, "rejected": 2}
    whole = services(answer)
    assert ask(whole, json_of({"notes": list[Note]}, repairs=0)).value is None and problems(whole) == {"malformed": 1}


def test_the_model_is_told_which_item_does_not_fit_and_the_better_answer_counts() -> None:
    mended = services(TWO % f"{GOOD}, {ONE_BAD}", TWO % f"{GOOD}, {GOOD}")
    assert len(ask(mended, NOTES).value["notes"]) == 2 and problems(mended) == {"repaired": 1}
    for again, left in (("no notes at all", 1), (TWO % f"{ONE_BAD}, {GOOD}, {GOOD}", 2)):
        module = services(TWO % f"{GOOD}, {ONE_BAD}", again)
        assert len(ask(module, NOTES).value["notes"]) == left
        assert problems(module) == {"unrepaired": 1, "malformed": 1, "rejected": 1}
        repair = module.llm.recorder.calls[-1]
        assert repair.tag.branch == "repair"
    assert "item 2 of 'notes'" in Services._why(NOTES, TWO % f"{GOOD}, {ONE_BAD}")


@pytest.mark.parametrize("text", ["prose", "[1]", '{"notes": 3}', TWO % ONE_BAD, '{"notes": [', "7", '{"other": []}'])
def test_nothing_is_salvaged_where_nothing_fits(text: str) -> None:
    module = services(text)
    assert ask(module, json_of({"notes": list[Note]}, repairs=0, whole=False)).value is None
    assert problems(module) == {"malformed": 1}


@dataclass(frozen=True)
class Review:
    insight: str
    notes: tuple[Note, ...] = ()


def test_other_fields_outlive_their_lists_and_must_fit_themselves() -> None:
    parse = json_of(Review, repairs=0, whole=False)
    assert ask(services(f'{{"insight": "i", "notes": [{ONE_BAD}]}}'), parse).value == Review("i")
    assert ask(services(f'{{"insight": 3, "notes": [{GOOD}]}}'), parse).value is None


def test_of_several_drafts_the_fullest_counts_and_a_null_is_no_item() -> None:
    parse = json_of({"notes": list[Note]}, repairs=0, whole=False)
    draft, final = TWO % f"{GOOD}, {ONE_BAD}", TWO % f'{GOOD}, {{"text": "c", "weight": 2.0}}, {ONE_BAD}'
    assert [n.text for n in ask(services(f"First {draft}, or better {final}"), parse).value["notes"]] == ["a", "c"]
    both = json_of({"notes": list[Note], "avoid": list[str]}, repairs=0, whole=False)
    found = ask(services(f'{{"notes": [{GOOD}], "avoid": null}}'), both).value
    assert found == {"notes": [Note("a", 1.0)], "avoid": []}
