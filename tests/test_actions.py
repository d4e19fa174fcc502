"""Text -> action: what parses, what is an error, and that nothing raises."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.actions import parse_action, same_action, suggest
from agentspec.reading import read
from agentspec.types import Action, ActionError, ActionSchema, ActionSpec, Parameter
from benchmarks.formats import FORMATS

SCHEMA = ActionSchema(
    {"MOVE": ActionSpec("MOVE", example="MOVE(1m, 2m)"), "WAIT": ActionSpec("WAIT", example="WAIT(10)")},
    aliases={"GO": "MOVE"},
    units={"m": 100.0},
)
MENU = ActionSchema(SCHEMA.actions, choices=("go to shop", "wait 5 min"))


@pytest.mark.parametrize(
    ("text", "name", "args", "kwargs"),
    [
        ("MOVE(12.5m, -3 m)", "MOVE", (1250.0, -300.0), {}),
        ("move(1m, y=2m, pace='accel').", "MOVE", (100.0,), {"y": 200.0, "pace": "accel"}),
        ("MOVE(10, 20)", "MOVE", (10, 20), {}),  # no unit: the schema's base unit
        ("GO(1m)", "MOVE", (100.0,), {}),
        ("```python\nWAIT(5)\n```", "WAIT", (5,), {}),
        ('{"action": "WAIT(5)", "future_plan": "rest"}', "WAIT", (5,), {}),
        ('{"action": {"action_call": "WAIT(5)"}}', "WAIT", (5,), {}),
        ("WAIT('5m')", "WAIT", ("5m",), {}),  # units are not read inside quotes
        ("WAIT([1, {'a': -2}], 'x' + 'y')", "WAIT", ([1, {"a": -2}], "xy"), {}),
        ("WAIT(5)\nand then more", "WAIT", (5,), {}),
    ],
)
def test_parses(text: str, name: str, args: tuple, kwargs: dict) -> None:
    action = parse_action(text, SCHEMA)
    assert isinstance(action, Action), action
    assert (action.name, action.args, action.kwargs) == (name, args, kwargs)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "PARSE_NOT_CALL"),
        ("I would move", "PARSE_NOT_CALL"),
        ("FLY(1)", "PARSE_UNKNOWN"),
        ("MOVE(__import__('os'))", "PARSE_ARGS"),
        ("MOVE(x for x in y)", "PARSE_ARGS"),
        ("MOVE(**{})", "PARSE_ARGS"),
        ("MOVE(1)(2)", "PARSE_ARGS"),
        ("MOVE(1 +)", "PARSE_ARGS"),
        ("MOVE(" * 300, "PARSE_NOT_CALL"),
        ("MOVE(" + "[" * 1500 + "]" * 1500 + ")", "PARSE_ARGS"),
        ("x" * 5000, "PARSE_TOO_LONG"),
    ],
)
def test_errors_are_messages(text: str, code: str) -> None:
    error = parse_action(text, SCHEMA)
    assert isinstance(error, ActionError) and error.code == code and error.message


def test_menu_texts_are_actions_word_for_word() -> None:
    action = parse_action(" Go to  SHOP ", MENU)
    assert isinstance(action, Action) and action.text == "go to shop"
    error = parse_action("fly", MENU)
    assert isinstance(error, ActionError) and "go to shop" in error.message
    assert isinstance(parse_action("WAIT(5)", MENU), Action)


@given(st.text(max_size=80) | st.text(alphabet="MOVEWAIT(){}[]'\",:=*+-. 0123456789m\n`", max_size=80))
def test_never_raises(text: str) -> None:
    assert isinstance(parse_action(text, SCHEMA), (Action, ActionError))


def test_suggest_names_the_nearest() -> None:
    assert suggest("raect", ["react", "cot"]) == "; did you mean react?"
    assert suggest("zzz", ["react", "cot"]) == "; known: cot, react"


FIELD = ActionSchema(
    {
        "VIEW_ORDERS": ActionSpec("VIEW_ORDERS", example="VIEW_ORDERS()"),
        "ACCEPT_ORDER": ActionSpec("ACCEPT_ORDER", parameters={"ids": Parameter("any")}, example="ACCEPT_ORDER([3])"),
        "MOVE": ActionSpec(
            "MOVE",
            parameters={
                "x": Parameter("float", resolution=10.0),
                "y": Parameter("float", resolution=10.0),
                "pace": Parameter("str", required=False, enum=("accel", "normal"), default="normal"),
            },
            example="MOVE(1m, 2m)",
        ),
        "WAIT": ActionSpec("WAIT", parameters={"seconds": Parameter("any", required=False)}, example="WAIT(60)"),
        "SWITCH": ActionSpec("SWITCH", parameters={"to": Parameter("str")}, example='SWITCH(to="walk")'),
    },
    units={"m": 100.0},
)
ENTRIES = ActionSchema({}, choices=("go to pickup of order 3", "go", "wait 1 minute", "accept order 3"))
WANTED = ["VIEW_ORDERS()", "ACCEPT_ORDER([3, 7])", 'MOVE(x=120.5m, y=-48m, pace="normal")', 'SWITCH(to="e-scooter")']


@pytest.mark.parametrize("call", WANTED)
@pytest.mark.parametrize("form", FORMATS)
def test_every_form_of_a_call_is_read(form: str, call: str) -> None:
    expected = parse_action(call, FIELD)
    assert isinstance(expected, Action)
    for text in (FORMATS[form](call, "WAIT(9)"), FORMATS[form](call, "WAIT(9)") + "\n"):
        action = parse_action(text, FIELD)
        assert same_action(action, expected, FIELD), (text, action)
        assert same_action(parse_action(action.text, FIELD), expected, FIELD)  # what is executed reads the same


@pytest.mark.parametrize("entry", ENTRIES.choices)
@pytest.mark.parametrize("form", FORMATS)
def test_every_form_of_a_menu_entry_is_read(form: str, entry: str) -> None:
    decoy = next(c for c in ("wait 1 minute", "accept order 3") if c != entry)
    text = FORMATS[form](entry, decoy)
    action = parse_action(text, ENTRIES)
    assert isinstance(action, Action) and action.name == entry, (text, action)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("MOVE(x: 12m, y: 3m)", "MOVE(12m, 3m)"),
        ("SWITCH(to=e-scooter)", 'SWITCH("e-scooter")'),
        ("VIEW\\_ORDERS()", "VIEW_ORDERS()"),
        ("view orders()", "VIEW_ORDERS()"),
        ("Action: VIEW_ORDERS", "VIEW_ORDERS()"),
        ("ACCEPT_ORDER[3, 7]", "ACCEPT_ORDER([3, 7])"),
        ("functions.VIEW_ORDERS()", "VIEW_ORDERS()"),
        ("MOVE(12m, −3m)", "MOVE(12m, -3m)"),
        ('{"VIEW_ORDERS": {}}', "VIEW_ORDERS()"),
        ('{"action": "MOVE", "x": 12, "y": "3m"}', "MOVE(12, 3m)"),
        ('[{"name": "MOVE", "arguments": {"x": "1m", "y": "2m"}}, {"name": "VIEW_ORDERS"}]', "MOVE(1m, 2m)"),
        ('{"action": "VIEW_ORDERS()", "notes": [1, 2', "VIEW_ORDERS()"),
        ("MOVE(12m,\n     3m)", "MOVE(12m, 3m)"),
        ("VIEW_ORDERS(); ACCEPT_ORDER([1])", "VIEW_ORDERS()"),
        ("I should not WAIT(60) now.\nAction: VIEW_ORDERS()", "VIEW_ORDERS()"),
        ("Thought: WAIT(60) is an option\nVIEW_ORDERS()", "VIEW_ORDERS()"),
        ("1. VIEW_ORDERS()\n2. ACCEPT_ORDER([1])", "VIEW_ORDERS()"),
    ],
)
def test_more_forms(text: str, expected: str) -> None:
    assert same_action(parse_action(text, FIELD), parse_action(expected, FIELD), FIELD), parse_action(text, FIELD)


@pytest.mark.parametrize(
    "text",
    [
        "<think>Action: WAIT(60)",  # cut off while it thought
        "<think>\nWAIT(60)\nWAIT(60)</think>",
        "WAIT(60)\nand so on " * 30 + "</think>",  # the block's beginning stands in the template
        "<reasoning>WAIT(60)</reasoning>",
        "<|channel|>analysis<|message|>WAIT(60)",
        "Thought: I could WAIT(60).",
        "I will not WAIT(60).",
        "Do not `WAIT(60)`",
        "Either WAIT(60) or VIEW_ORDERS()",
        "1. WAIT(60)\n2. VIEW_ORDERS()\nThe second one is best.",
        "Action: I do not know\nAction: WAIT(60)",  # the first Action line counts
        "Thought: hm\nObservation: you waited\nAction: WAIT(60)",  # built on an observation that it made up
        "WAIT(60)(3)",
        'Action: {"foo": 1}',
        "Action: MOVE",
    ],
)
def test_what_is_no_action_is_not_executed_either(text: str) -> None:
    error = parse_action(text, FIELD)
    assert isinstance(error, ActionError), error
    assert isinstance(parse_action(error.text, FIELD), ActionError)


def test_a_cut_answer_is_told_from_nonsense() -> None:
    assert read("I think that", FIELD, cut=True).action.code == "TRUNCATED"
    assert read("I think that", FIELD).action.code == "PARSE_NOT_CALL"
    assert read("<think>I", FIELD).action.code == "TRUNCATED"
    assert read("Action: MOVE(12m, 3", FIELD, cut=True).action.code == "TRUNCATED"
    assert isinstance(read("Action: WAIT(60)\nBecause it is", FIELD, cut=True).action, Action)
    assert read("Action: FLY(1)", FIELD, cut=True).action.code == "PARSE_UNKNOWN"


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("ACCEPT_ORDER(0)", "ACCEPT_ORDER([0])", True),
        ("ACCEPT_ORDER(ids=0)", "ACCEPT_ORDER([0])", True),
        ("WAIT(60)", "WAIT(60.0)", True),
        ("WAIT(60)", "WAIT(seconds=60)", True),
        ('MOVE(1m, 2m, pace="normal")', "MOVE(1m, 2m)", True),
        ("MOVE(1.02m, 2m)", "MOVE(1m, 2.01m)", True),  # within the resolution of 10 cm
        ("MOVE(1.2m, 2m)", "MOVE(1m, 2m)", False),
        ('MOVE(1m, 2m, pace="accel")', "MOVE(1m, 2m)", False),
        ("ACCEPT_ORDER([0, 1])", "ACCEPT_ORDER([0])", False),
        ("WAIT(60)", 'WAIT("charge_done")', False),
        ("WAIT()", "VIEW_ORDERS()", False),
    ],
)
def test_actions_that_do_the_same_are_the_same(one: str, other: str, same: bool) -> None:
    assert same_action(parse_action(one, FIELD), parse_action(other, FIELD), FIELD) is same


@given(st.text(alphabet="<think>/`*ACTIONactionWAIT(){}[]'\",:\\n\n1. #-|", max_size=120))
def test_errors_never_read_as_actions(text: str) -> None:
    reading = read(text, FIELD)
    if isinstance(reading.action, ActionError):
        assert isinstance(parse_action(reading.action.text, FIELD), ActionError)
    else:
        assert same_action(parse_action(reading.action.text, FIELD), reading.action, FIELD)


def test_the_reader_is_quick_on_hostile_answers() -> None:
    for text in ("MOVE(" * 20_000, "{" * 50_000, "Action: " * 10_000, "<think>" * 10_000, "`WAIT(" + "[" * 90_000):
        assert isinstance(parse_action(text, FIELD), ActionError)


def test_the_couriers_actions_know_what_is_left_out_and_what_matters() -> None:
    from agentspec.envs.deliverybench.world.grammar import schema_for
    from agentspec.envs.deliverybench.world.rules import rules_named

    for rules in ("fair", "original"):
        schema = schema_for(rules_named(rules))
        for one, other in [
            ("MOVE(139.6m, 24m)", 'MOVE(139.8m, 24.1m, pace="normal")'),
            ("ACCEPT_ORDER(0)", "ACCEPT_ORDER([0])"),
            ("WAIT(60)", "WAIT(60.0)"),
            ('BUY("ice_pack")', 'BUY(item_id="ice_pack", qty=1)'),
            ("PICKUP(3)", "PICKUP(orders=[3])"),
        ]:
            assert same_action(parse_action(one, schema), parse_action(other, schema), schema), (one, other)
        far = parse_action("MOVE(141m, 24m)", schema)
        assert not same_action(far, parse_action("MOVE(139.6m, 24m)", schema), schema)
