"""Kinds of failure: what the rules find in played episodes, the judge's answers, agreement with labels."""

from __future__ import annotations

import pytest

from agentspec.failures import LEAVES, Sign, in_a_row, is_failure, leading, revisits, signs
from agentspec.types import Task
from eval.failures import by_scaffold, diagnose, paper_shares, replayed

FETCH = Task("minigrid", 0, {"level": "MiniGrid-Fetch-5x5-N2-v0"})
GOTO = Task("minigrid", 0, {"level": "MiniGrid-GoToObject-6x6-N2-v0"})
EMPTY = Task("minigrid", 0, {"level": "MiniGrid-Empty-6x6-v0"})
AGAIN = "understanding/state_confusion/history_misunderstood"
COURIER = Task("deliverybench", 0, {"size": "tiny", "shift_hours": 1.0})


def leaves(task: Task, *actions: str) -> list[tuple[str, int]]:
    return [(sign.leaf, sign.step) for sign in signs(replayed(task, actions))]


def test_texts_that_are_no_action() -> None:
    found = leaves(COURIER, "FLY()", "MOVE(x='far')", "VIEW_ORDERS()")
    assert found == [("parse/action_interface/hallucination", 0), ("parse/action_interface/parameter", 1)]
    first = replayed(EMPTY, ["TURN_LEFT()"]).transitions[0]
    assert leaves(EMPTY, "TURN_LEFT()", first.next_text[:300])[-1] == ("parse/unstructured_memory", 1)


def test_an_action_that_fails_again_for_the_same_reason() -> None:
    wrong = "DROP_OFF(0, 'hand_to_customer')"
    kind = "understanding/state_confusion/{}"
    assert (kind.format("history_misunderstood"), 1) in leaves(COURIER, wrong, wrong)
    between = [f"WAIT({10 + i})" for i in range(9)]
    assert (kind.format("missing_history"), 10) in leaves(COURIER, wrong, *between, wrong)
    assert not any("state_confusion" in leaf for leaf, _ in leaves(COURIER, wrong))


@pytest.mark.parametrize("form", ["take {}", 'PICKUP("{}")'])
def test_taking_what_the_task_does_not_name(form: str) -> None:
    mode = {"action_mode": "menu" if form.startswith("take") else "native"}
    wrong = ("grounding/object/misclassification", 0)
    assert wrong in leaves(Task("alfred", 4, mode), form.format("mug 1"))  # it asks for a plate
    assert wrong not in leaves(Task("alfred", 4, mode), form.format("plate 1"))
    assert wrong not in leaves(Task("alfred", 9, mode), form.format("knife 1"))  # it asks for a slice


def test_running_into_walls_and_in_circles() -> None:
    found = leaves(EMPTY, *["FORWARD()"] * 8)  # 6x6: three steps to the wall, then it is in the way
    assert {leaf for leaf, _ in found} == {"grounding/spatial/stuck", AGAIN} and found[0][1] >= 4
    assert leading(signs(replayed(EMPTY, ["FORWARD()"] * 8))) == "grounding/spatial/stuck"
    hall = Task("minigrid", 3, {"level": "MiniGrid-Empty-16x16-v0"})  # whose walls are out of sight at first
    assert leaves(hall, *["FORWARD()"] * 8) == []
    circles = leaves(EMPTY, *["TURN_LEFT()"] * 12)  # each of four views is seen for the third time from step 8 on
    assert circles == [("grounding/spatial/stuck", step) for step in (8, 9, 10, 11)]


def test_acting_on_nothing_and_saying_done_elsewhere() -> None:
    nothing = "grounding/object/hallucination"
    assert leaves(EMPTY, "PICK_UP()") == [(nothing, 0)]
    # Done again at once it is also a confusion, but no circle: nobody moved.
    again = leaves(EMPTY, *["PICK_UP()"] * 4)
    assert again == [(nothing, 0)] + [(leaf, step) for step in (1, 2, 3) for leaf in (nothing, AGAIN)]
    assert (AGAIN, 2) not in leaves(EMPTY, "PICK_UP()", "TURN_LEFT()", "PICK_UP()")
    [(leaf, step)] = leaves(GOTO, "DONE()") or [("", 0)]
    assert leaf in ("grounding/spatial/distance", "grounding/object/hallucination") and step == 0


def test_money_and_time_misjudged() -> None:
    episode = replayed(COURIER, ["VIEW_ORDERS()", "VIEW_ORDERS()"])
    assert [s.leaf for s in signs(episode)] == ["understanding/state_confusion/history_misunderstood"]
    assert [s.leaf for s in signs(replayed(COURIER, ["WAIT(600)"]))] == ["understanding/knowledge/strategy"]


def test_a_text_that_was_no_action_is_repeated_too() -> None:
    assert (AGAIN, 1) in leaves(COURIER, "SLEEP(60)", "SLEEP(60)")
    assert not any(leaf == AGAIN for leaf, _ in leaves(COURIER, "SLEEP(60)", "SLEEP(70)"))


def test_a_copy_is_one_however_it_is_broken_into_lines() -> None:
    shown = replayed(EMPTY, ["TURN_LEFT()"]).transitions[0].next_text
    assert "\n" in shown[:150]
    assert ("parse/unstructured_memory", 1) in leaves(EMPTY, "TURN_LEFT()", " ".join(shown.split())[:200])


def test_what_a_refusal_of_the_courier_speaks_of() -> None:
    accept = replayed(COURIER, ["VIEW_ORDERS()"]).transitions[0].input.state["offers"][0]["id"]
    far = leaves(COURIER, f"ACCEPT_ORDER({accept})", f"PICKUP(orders=[{accept}])", "ACCEPT_ORDER(99)")
    assert ("grounding/spatial/distance", 1) in far and ("parse/action_interface/parameter", 2) in far
    assert leaves(COURIER, "CHARGE(target_pct=80)") == [("understanding/knowledge/rule_unfamiliar", 0)]


def test_a_shift_that_leads_nowhere() -> None:
    strategy = "understanding/knowledge/strategy"
    waits = Task("deliverybench", 0, {"size": "tiny", "shift_hours": 1.0, "max_steps": 6})
    assert leaves(waits, *["WAIT(60)"] * 4) == []  # four minutes, and the shift goes on
    assert [step for leaf, step in leaves(waits, *["WAIT(60)"] * 6) if leaf == strategy] == [4, 5, 5]
    strolls = leaves(waits, *["MOVE(20m, 60m)", "MOVE(60m, 60m)"] * 3)  # six steps, and nothing was fetched
    assert (strategy, 5) in strolls and (strategy, 4) not in strolls
    menu = Task("deliverybench", 0, {**waits.options, "action_mode": "menu", "observation": "compact"})
    assert AGAIN in {leaf for leaf, _ in leaves(menu, *["more choices"] * 6)}
    assert AGAIN not in {leaf for leaf, _ in leaves(menu, "more choices", "wait 1 minute", "more choices")}


def test_moves_that_lead_nowhere() -> None:
    strategy = ("understanding/knowledge/strategy", 11)
    short = {"level": "MiniGrid-Empty-6x6-v0", "max_steps": 12}
    assert strategy in leaves(Task("minigrid", 0, short), *["TURN_LEFT()"] * 12)
    assert strategy not in leaves(Task("minigrid", 0, short), *["FORWARD()"] * 12)  # to the wall: more than two cells
    assert strategy not in leaves(Task("minigrid", 0, short), *["PICK_UP()"] * 12)  # nothing that was possible
    home = Task("robothor", 0, {"max_steps": 12})
    assert strategy in leaves(home, *["ROTATE_LEFT()"] * 12)
    assert (AGAIN, 4) in leaves(home, *["LOOK_DOWN()"] * 5)


def test_circles_and_values_in_a_room() -> None:
    room = Task("alfred", 4, {"max_steps": 9})
    spins = [step for leaf, step in leaves(room, *["ROTATE_LEFT()"] * 9) if leaf == "grounding/spatial/stuck"]
    assert all(step >= 8 for step in spins)  # four views, the third time round
    assert leaves(room, "PICKUP()") == [("parse/action_interface/parameter", 0)]


def test_the_leading_kind_and_the_diagnosis() -> None:
    stuck, done = "grounding/spatial/stuck", "grounding/spatial/distance"
    found = [Sign(done, 0, ""), Sign(stuck, 1, ""), Sign(stuck, 1, "again"), Sign(stuck, 2, "")]
    assert leading(found) == stuck and leading([]) == ""
    episode = replayed(EMPTY, ["TURN_LEFT()"] * 100)
    assert is_failure(episode) and diagnose(episode).leaf == stuck
    with pytest.raises(ValueError, match="unknown kind"):
        Sign("spatial", 0, "")


def test_shares_per_scaffold_count_failures_only() -> None:
    stuck = diagnose(replayed(EMPTY, ["TURN_LEFT()"] * 100))
    found = by_scaffold([("minigrid", "plain", stuck), ("minigrid", "plain", stuck)])
    shares = found["minigrid", "plain"]
    assert (shares.episodes, shares.failed, shares.share("grounding/spatial/stuck")) == (2, 2, 1.0)
    assert sum(paper_shares("minigrid").values()) == pytest.approx(1.0, abs=0.01)
    assert paper_shares("minigrid").keys() == set(LEAVES) and paper_shares("elsewhere") == {}


def test_positions() -> None:
    assert list(revisits("abaaa")) == [3, 4]
    assert list(in_a_row([True, True, True, False, True])) == [1, 2]
