"""The reader of answers at its limits: tool calls of model families, signs of other scripts, and endless answers."""

from __future__ import annotations

import time

import pytest

from agentspec.actions import canonical, parse_action
from agentspec.envs.deliverybench.world.grammar import schema_for
from agentspec.envs.deliverybench.world.rules import FAIR
from agentspec.types import Action, ActionSchema

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
