"""The reader of answers at its limits: tool calls of model families, signs of other scripts, and endless answers."""

from __future__ import annotations

import time

import pytest

from agentspec.actions import canonical, parse_action
from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.world.grammar import schema_for
from agentspec.envs.deliverybench.world.rules import FAIR
from agentspec.types import Action, ActionError, ActionSchema

SCHEMA = schema_for(FAIR)
CALL = "MOVE(120.5m, -48m)"
JSON = '{"x": 120.5, "y": -48}'
FORMS = {
    "glm": "<tool_call>MOVE\n<arg_key>x</arg_key>\n<arg_value>120.5</arg_value>\n<arg_key>y</arg_key>\n"
    "<arg_value>-48</arg_value>\n</tool_call>",
    "mistral": f"[TOOL_CALLS]MOVE[ARGS]{JSON}",
    "deepseek": f"<｜tool▁calls▁begin｜><｜tool▁call▁begin｜>MOVE<｜tool▁sep｜>{JSON}<｜tool▁call▁end｜>",
    "deepseek, older": f"<｜tool▁call▁begin｜>function<｜tool▁sep｜>MOVE\n```json\n{JSON}\n```<｜tool▁call▁end｜>",
    "kimi": f"<|tool_call_begin|>functions.MOVE:0<|tool_call_argument_begin|>{JSON}<|tool_call_end|>",
    "gemini": "```tool_code\nprint(MOVE(x=120.5, y=-48))\n```",
    "list with arguments": '{"action": ["MOVE", 120.5, -48]}',
    "type": '{"type": "MOVE", "x": 120.5, "y": -48}',
    "commented json": '{\n  "action": "MOVE", // near\n  "args": {"x": 120.5, "y": -48}\n}',
    "yaml": "action: MOVE\nargs:\n  x: 120.5\n  y: -48",
    "fullwidth signs": "Action：MOVE（120.5m，-48m）",
    "dash for minus": "MOVE(120.5m, –48m)",
    "narrow space": "MOVE(120.5\u202fm, -48\u00a0m)",
    "unit in full": "MOVE(120.5 meters, -48 meters)",
}
ENDLESS = [
    "a\n",
    "result:\n",
    "*",
    " ",
    "{",
    "MOVE(",
    "`",
    "x\n\n\n",
    "accept order 3 ",
    "A",
    "<think>",
    "- MOVE(1,2)\n",
]


@pytest.mark.parametrize("form", FORMS)
def test_a_call_is_read_in_the_form_of(form: str) -> None:
    action, meant = parse_action(FORMS[form], SCHEMA), parse_action(CALL, SCHEMA)
    assert isinstance(action, Action) and isinstance(meant, Action)
    assert canonical(action, SCHEMA) == canonical(meant, SCHEMA)


def test_a_remark_that_takes_the_action_back_is_no_politeness() -> None:
    assert not isinstance(parse_action("WAIT(60). No, MOVE(1m, 2m) is better than that", SCHEMA), Action)


@pytest.mark.parametrize("unit", ENDLESS)
@pytest.mark.parametrize("before", ["", "x", "Thought: t\n"])
def test_a_million_characters_are_read_in_seconds(unit: str, before: str) -> None:
    menu = ActionSchema(SCHEMA.actions, SCHEMA.aliases, SCHEMA.units, ("accept order 3", "accept order 31", "wait"))
    text = before + unit * (1_000_000 // len(unit)) + "x"
    for schema in (SCHEMA, menu):
        began = time.process_time()
        parse_action(text, schema)
        assert time.process_time() - began < 10


@pytest.mark.parametrize("words", [5_000, 200_000])
def test_an_action_after_many_words_is_found(words: int) -> None:
    for text in (f"{'word ' * words}\nAction: {CALL}", f"Action: {CALL}\n{'word ' * words}"):
        action = parse_action(text, SCHEMA)
        assert isinstance(action, Action) and action.name == "MOVE"


@pytest.mark.parametrize(
    "text",
    [
        "MOVE((120.5m, -48m))",
        "MOVE([120.5, -48])",
        "MOVE(to=(120.5m, -48m))",
        "MOVE(position=[120.5, -48])",
        'MOVE({"x": 120.5, "y": -48})',
        'MOVE(target={"x": 120.5, "y": "-48m"})',
        '{"action": "MOVE", "args": [[120.5, -48]]}',
        '{"action": "MOVE", "args": {"to": ["120.5m", "-48m"]}}',
        '{"name": "MOVE", "arguments": {"destination": {"x": 120.5, "y": -48}}}',
    ],
)
def test_a_point_given_as_one_value_is_the_point(text: str) -> None:
    action, meant = parse_action(text, SCHEMA), parse_action(CALL, SCHEMA)
    assert isinstance(action, Action) and isinstance(meant, Action)
    assert canonical(action, SCHEMA) == canonical(meant, SCHEMA)
    fast = parse_action("MOVE((120.5m, -48m), pace='accel')", SCHEMA)
    assert isinstance(fast, Action) and fast.args == (120.5, -48.0) and fast.kwargs == {"pace": "accel"}
    world = DeliveryBenchEnv(size="tiny")
    world.reset(seed=0)
    assert not world.step("MOVE((10m, 5m))")[4]["error"].startswith("MOVE:")  # the arguments are none of its complaints


@pytest.mark.parametrize(
    "text",
    ["MOVE((1, 2, 3))", "MOVE(to=(1,))", "MOVE(x=(1, 2))", "MOVE(to='restaurant 1')", "MOVE((1, 2), (3, 4))", "MOVE()"],
)
def test_what_is_no_point_is_told_so(text: str) -> None:
    error = parse_action(text, SCHEMA)
    assert isinstance(error, ActionError) and error.code == "PARSE_ARGS"
    assert "write MOVE(120.5m, -48m" in error.message


def test_a_list_of_one_is_the_one() -> None:
    action = parse_action('DROP_OFF(oid=[3], method=["knock"])', SCHEMA)
    assert isinstance(action, Action) and action.kwargs == {"oid": 3, "method": "knock"}
