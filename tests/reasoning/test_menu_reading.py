"""Menu entries are common words: which answers mean one, and which only mention it."""

from __future__ import annotations

import pytest

from agentspec.actions import parse_action
from agentspec.envs.deliverybench.world.grammar import schema_for
from agentspec.envs.deliverybench.world.rules import FAIR
from agentspec.types import Action, ActionSchema
from benchmarks.formats import FORMATS

NATIVE = schema_for(FAIR)
MENU = (
    "rent car", "hurry to restaurant 4", "go to restaurant 4", "accept order 2", "accept orders 2, 5",
    "accept order 12", "pick up order 3", "wait 1 minute", "wait for order 3", "charge to 80%", "go to car rental",
    "go to car", "deliver order 3 by hand", "more choices", "wait",
)  # fmt: skip
SCHEMA = ActionSchema(NATIVE.actions, NATIVE.aliases, NATIVE.units, MENU)

MEANT = {
    "Rent car.": "rent car",
    "rent car (fast)": "rent car",
    "rent car because it is fast": "rent car",
    "accept order 2 ($7.7, 183m + 686m, 9 min)": "accept order 2",
    "accept orders 2, 5, because they are near": "accept orders 2, 5",
    "accept order 2. It pays best.": "accept order 2",
    "accept order 2 and then hurry to restaurant 4": "accept order 2",
    "pick up order 3, it is ready": "pick up order 3",
    "I'll accept order 2.": "accept order 2",
    "Action: rent car. Speed matters.": "rent car",
    "rent car\n\nThis is the best because it pays.": "rent car",
    "accept order 12": "accept order 12",
    "wait": "wait",
    "go to car": "go to car",
}
NOT_MEANT = (
    # A sentence that begins with the words of an entry.
    "Wait. Let me think about the orders again.", "Wait 1 minute. Capital letters matter.",
    "More choices. Capital idea.", "wait - let me think again", "Wait! I have not looked at the board.",
    # Another action than the entry.
    "accept order 2 and 3", "accept order 2 and order 5", "accept orders 2, 5 and 12", "pick up order 3, 5",
    "Action: accept order 2 and 5", "go to car dealer", "accept order 123",
    # A choice that is left open.
    "accept order 2 or order 5", "go to car rental or rent car", "hurry to restaurant 4 / go to restaurant 4",
    "wait 1 minute if the food is not ready, otherwise pick up order 3",
    "rent car; hurry to restaurant 4; wait 1 minute",
    "Rent car. It costs $1 a minute but is fast.\nWait 1 minute. It costs nothing.\nI would look at the others first.",
    # Taken back.
    "Rent car. Too expensive.", "rent car - no, hurry to restaurant 4 instead", "rent car (not worth it)",
    "rent car\nNo: hurry to restaurant 4", "Action: wait. Actually, hurry to restaurant 4", "rent car? No.",
    # Mentioned.
    "It would be wrong to rent car.", "There is nothing to do but wait", "I had to wait", "We may have to wait.",
    "I considered to rent car", "unlike before, no need to wait", "The choice to wait", "Should I wait?",
)  # fmt: skip


@pytest.mark.parametrize("text", MEANT)
def test_an_entry_that_is_meant_is_read(text: str) -> None:
    action = parse_action(text, SCHEMA)
    assert isinstance(action, Action) and action.text == MEANT[text]


@pytest.mark.parametrize("text", NOT_MEANT)
def test_an_entry_that_is_not_meant_is_asked_for_again(text: str) -> None:
    assert not isinstance(parse_action(text, SCHEMA), Action)


@pytest.mark.parametrize("entry", ["rent car", "accept orders 2, 5", "wait for order 3", "wait"])
def test_every_form_is_read_with_a_menu_too(entry: str) -> None:
    for name, form in FORMATS.items():
        action = parse_action(form(entry, "hurry to restaurant 4"), SCHEMA)
        assert isinstance(action, Action) and action.text == entry, name


def test_beside_a_menu_a_word_is_no_call() -> None:
    schema = ActionSchema(NATIVE.actions, NATIVE.aliases, NATIVE.units, MENU[:-1])
    assert not isinstance(parse_action("Action: wait", schema), Action)
    assert isinstance(parse_action("Action: VIEW_ORDERS", schema), Action)
    assert isinstance(parse_action("Action: wait(5)", schema), Action)
