"""Text -> action: what parses, what is an error, and that nothing raises."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.actions import parse_action, suggest
from agentspec.types import Action, ActionError, ActionSchema, ActionSpec

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
