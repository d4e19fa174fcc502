"""What chat models write around an action: what is read as which, and what is asked for again rather than guessed.

A wrong action costs more than another call, so an answer that leaves a choice, takes an action back, or only speaks
of it holds none.
"""

from __future__ import annotations

import pytest

from agentspec.actions import canonical, parse_action
from agentspec.envs.deliverybench.world.grammar import schema_for
from agentspec.envs.deliverybench.world.rules import FAIR
from agentspec.types import Action, ActionSchema, ActionSpec, Parameter

NATIVE = schema_for(FAIR)
CHOICES = ("accept order 2", "go to restaurant 4", "pick up order 3", "wait 1 minute", "charge to 80%", "rent car")
MENU = ActionSchema(NATIVE.actions, NATIVE.aliases, NATIVE.units, CHOICES)
GRID = ActionSchema(
    {name: ActionSpec(name, example=f"{name}()") for name in ("TURN_LEFT", "TURN_RIGHT", "FORWARD", "DONE")},
    aliases={"LEFT": "TURN_LEFT", "RIGHT": "TURN_RIGHT"},
)
HOUSE = ActionSchema({n: ActionSpec(n, parameters={"object": Parameter("str")}) for n in ("PICKUP", "OPEN")})

READ = [
    # blocks, tables and boxes
    (NATIVE, "<plan>\n1. WAIT(60)\n2. PICKUP(orders=[3])\n</plan>\nVIEW_ORDERS()", "VIEW_ORDERS()"),
    (NATIVE, "<summary>\nWAIT(60)\n</summary>\nPICKUP(orders=[3])", "PICKUP(orders=[3])"),
    (NATIVE, "~~WAIT(60)~~\nVIEW_ORDERS()", "VIEW_ORDERS()"),
    (NATIVE, "$$\\boxed{\\text{WAIT(60)}}$$", "WAIT(60)"),
    (NATIVE, "\\boxed{\\texttt{DROP\\_OFF(oid=3, method='knock')}}", "DROP_OFF(3, 'knock')"),
    (
        NATIVE,
        "| Option | |\n|---|---|\n| WAIT(60) | bad |\n| VIEW_ORDERS() | good |\n\n**Decision:** `VIEW_ORDERS()`",
        "VIEW_ORDERS()",
    ),
    (MENU, "| action | score |\n|---|---|\n| rent car | 2 |\n| accept order 2 | 9 |\n\n**accept order 2**", CHOICES[0]),
    # lists of options and of what was done
    (NATIVE, "3. WAIT(60) -> waited 60s\n4. MOVE(1m,2m) -> moved\n\nVIEW_ORDERS()", "VIEW_ORDERS()"),
    (NATIVE, "- WAIT(60)\n- PICKUP(orders=[3])\n\nPICKUP(orders=[3])", "PICKUP(orders=[3])"),
    (NATIVE, "WAIT(60) ❌\nVIEW_ORDERS() ✅", "VIEW_ORDERS()"),
    (MENU, "rent car (❌)\npick up order 3 (✅)", "pick up order 3"),
    (NATIVE, "WAIT(60)\n\nWait, the food is ready.\nPICKUP(orders=[3])", "PICKUP(orders=[3])"),
    # labels
    (NATIVE, "Next step: VIEW_ORDERS()", "VIEW_ORDERS()"),
    (NATIVE, "Decision: no waiting.\nAction: VIEW_ORDERS()", "VIEW_ORDERS()"),
    (NATIVE, "Acción: ACCEPT_ORDER([3])  # pago alto", "ACCEPT_ORDER([3])"),
    (NATIVE, "Action: [WAIT(60)]", "WAIT(60)"),
    (MENU, "Action: [rent car]", "rent car"),
    (MENU, "Choice: pick up order 3", "pick up order 3"),
    (NATIVE, "Wrong action: WAIT(60)\nRight action: VIEW_ORDERS()", "VIEW_ORDERS()"),
    (NATIVE, "<|START_THINKING|>Action: WAIT(5)<|END_THINKING|><|START_RESPONSE|>WAIT(60)<|END_RESPONSE|>", "WAIT(60)"),
    (NATIVE, "PICKUP(orders=[3]) instead of WAIT(60)", "PICKUP(orders=[3])"),
    # several in one answer: the first
    (NATIVE, "[WAIT(60), VIEW_BAG()]", "WAIT(60)"),
    (NATIVE, "MOVE(1m, 2m) && PICKUP(orders=[3])", "MOVE(1m, 2m)"),
    (GRID, "TURN_LEFT(), FORWARD(), FORWARD()", "TURN_LEFT()"),
    # data
    (NATIVE, "action: WAIT\nseconds: 60", "WAIT(60)"),
    (NATIVE, "```yaml\naction: DROP_OFF\noid: 3\nmethod: knock\n```", "DROP_OFF(3, 'knock')"),
    (NATIVE, '{"rejected": "WAIT(60)", "decision": "VIEW_ORDERS()"}', "VIEW_ORDERS()"),
    (NATIVE, '{"state": {"hint": "PICKUP(orders=[3])"}}\nAction: WAIT(60)', "WAIT(60)"),
    # arguments
    (NATIVE, "ACCEPT_ORDER(3, 7)", "ACCEPT_ORDER([3, 7])"),
    (NATIVE, "PICKUP(3, 5)", "PICKUP(orders=[3, 5])"),
    (NATIVE, "WAIT(60s)", "WAIT(60)"),
    (NATIVE, "WAIT(2 min)", "WAIT(120)"),
    (NATIVE, '{"action": "WAIT", "args": {"seconds": "60s"}}', "WAIT(60)"),
    (NATIVE, "CHARGE(target_pct=80 %)", "CHARGE(80)"),
    (NATIVE, "PLACE_FOOD_IN_BAG(order 3: 1,2 -> A; 3 -> B)", 'PLACE_FOOD_IN_BAG("order 3: 1,2 -> A; 3 -> B")'),
    (HOUSE, "PICKUP(apple 1)", 'PICKUP("apple 1")'),
    (HOUSE, 'Open (the fridge is closed).\nOPEN("fridge 1")', 'OPEN("fridge 1")'),
    (GRID, "FORWARD (the goal is 3 cells ahead)", "FORWARD()"),
    (GRID, "Left (wall)\nAhead (lava)\nRight (free)\nSo TURN_RIGHT()", "TURN_RIGHT()"),
]

ASKED_AGAIN = [
    # a choice that is left open
    (NATIVE, "MOVE(1m, 2m) or WAIT(60)"),
    (NATIVE, "Action: PICKUP(orders=[3]) if ready, else WAIT(60)"),
    (NATIVE, "```python\nif ready:\n    PICKUP(orders=[3])\nelse:\n    WAIT(60)\n```"),
    (NATIVE, "| Option | |\n|---|---|\n| WAIT(60) | bad |\n| VIEW_ORDERS() | good |\n\nSo the second."),
    (NATIVE, '{"options": [{"action": "WAIT(60)"}, {"action": "VIEW_ORDERS()"}], "best": 2}'),
    (NATIVE, '[{"action": "WAIT(60)", "score": 2}, {"action": "VIEW_ORDERS()", "score": 9}]\nBest: the second.'),
    (NATIVE, "From the options\n\nWAIT(18.6)\nPICKUP(orders=[6])\n\nthe second one is best."),
    (MENU, "From the options\n\nwait 1 minute\npick up order 3\n\nthe second one is best."),
    (NATIVE, "- WAIT(60)\nVIEW_ORDERS()"),
    # taken back
    (NATIVE, "WAIT(60)\nActually no, VIEW_ORDERS() is better."),
    (NATIVE, "Action: WAIT(60)\nCorrection: Action: VIEW_ORDERS()"),
    (NATIVE, "Action: WAIT(60)\nFinal Action: VIEW_ORDERS()"),
    (NATIVE, "Action: WAIT(60)\nonly if it is not ready."),
    (MENU, "Action: pick up order 3\nNo wait, rent car"),
    (NATIVE, "WAIT(60) - a bad idea. VIEW_ORDERS() - good."),
    (NATIVE, "~~WAIT(60)~~"),
    # only spoken of
    (NATIVE, "My previous action was `WAIT(60)`."),
    (NATIVE, "`WAIT(60)` is a bad idea."),
    (NATIVE, "**WAIT(60)** would waste time."),
    (NATIVE, "For example, WAIT(60)."),
    (NATIVE, "The format is NAME(arguments), e.g. `WAIT(60)`."),
    (NATIVE, "It is wrong to use e.g. WAIT(60)"),
    (NATIVE, "Should I use `PICKUP(orders=[3])`?"),
    (NATIVE, '"PICKUP(orders=[3])" was executed.'),
    (NATIVE, "After `PICKUP(orders=[3])` I will drive."),
    (NATIVE, "Je ne ferai pas WAIT(60)."),
    (NATIVE, "Ich würde nicht WAIT(60)."),
    (NATIVE, "不要 WAIT(60)"),
    (NATIVE, '{"observation": {"last_action": "WAIT(60)"}, "thought": "x", "action": null}'),
    # arguments that are none
    (NATIVE, "```python\nx, y = 120.5, -48\nMOVE(x, y)\n```"),
    (NATIVE, 'MOVE("here", "there")'),
]


@pytest.mark.parametrize(("schema", "answer", "meant"), READ)
def test_an_answer_is_read_as(schema: ActionSchema, answer: str, meant: str) -> None:
    action, expected = parse_action(answer, schema), parse_action(meant, schema)
    assert isinstance(action, Action) and isinstance(expected, Action), action
    assert canonical(action, schema) == canonical(expected, schema)
    assert canonical(parse_action(action.text, schema), schema) == canonical(expected, schema)


@pytest.mark.parametrize(("schema", "answer"), ASKED_AGAIN)
def test_an_answer_that_means_no_one_action_is_asked_for_again(schema: ActionSchema, answer: str) -> None:
    assert not isinstance(parse_action(answer, schema), Action)


@pytest.mark.parametrize(
    "answer",
    [
        "Action: PICKUP(orders=[3])\n\nWait for the result.",
        "Action: PICKUP(orders=[3])\nNo other action is needed.",
        "PICKUP(orders=[3])\n\nThis is better than WAIT(60).",
        "Action: PICKUP(orders=[3]), not WAIT(60)",
        "`PICKUP(orders=[3])` is the best next step.",
        "Let me do `PICKUP(orders=[3])` now.",
        "PICKUP(orders=[3])\n\nThe last order is ready, too.",
        "1. PICKUP(orders=[3])\n2. MOVE(5m, 6m)\n3. WAIT(60)",
    ],
)
def test_what_merely_looks_like_second_thoughts_is_none(answer: str) -> None:
    action = parse_action(answer, NATIVE)
    assert isinstance(action, Action) and action.name == "PICKUP"
