"""Goal conditions of every task type, from metadata alone, with slices and without; and what changes objects."""

from __future__ import annotations

import pytest

from agentspec.envs.alfred.goals import CONDITIONS, Changes, progress
from agentspec.envs.alfred.trials import TYPES, Targets


def thing(name, *, inside=(), position=(0.0, 0.0, 0.0), **flags):
    """Metadata of an object whose id is its name; `inside` is what it holds."""
    told = dict.fromkeys(("pickupable", "receptacle", "toggleable", "isToggled", "isPickedUp", "visible"), False)
    place = dict(zip("xyz", position, strict=True))
    return {"objectId": name, "receptacleObjectIds": list(inside), "position": place, **told, **flags}


def metadata(*objects, held=(), action="", success=True):
    inventory = [{"objectId": name} for name in held]
    told = {"objects": list(objects), "inventoryObjects": inventory}
    return told | {"lastAction": action, "lastActionSuccess": success}


def apple(name="Apple|1"):
    return thing(name, pickupable=True)


def table(*inside):
    return thing("DiningTable|1", receptacle=True, inside=inside)


APPLE = Targets("Apple", "DiningTable")
SLICED = Targets("Apple", "DiningTable", sliced=True)
PIECES = ("Apple|1|AppleSliced_1", "Apple|1|AppleSliced_2")
HOT = Changes(hot={"Apple|1", PIECES[0]})

CASES = [
    ("pick_and_place_simple", APPLE, metadata(apple(), table()), Changes(), (0, 1)),
    ("pick_and_place_simple", APPLE, metadata(apple(), table("Apple|1")), Changes(), (1, 1)),
    ("pick_and_place_simple", SLICED, metadata(apple(), table("Apple|1")), Changes(), (0, 2)),
    ("pick_and_place_simple", SLICED, metadata(apple(PIECES[0]), table()), Changes(), (1, 2)),
    ("pick_and_place_simple", SLICED, metadata(apple(PIECES[0]), table(PIECES[0])), Changes(), (2, 2)),
    ("pick_two_obj_and_place", APPLE, metadata(apple(), apple("Apple|2"), table("Apple|1")), Changes(), (1, 2)),
    ("pick_two_obj_and_place", SLICED, metadata(*map(apple, PIECES), table(*PIECES)), Changes(), (4, 4)),
    ("pick_two_obj_and_place", SLICED, metadata(*map(apple, PIECES), table(PIECES[0])), Changes(), (3, 4)),
    ("pick_heat_then_place_in_recep", APPLE, metadata(apple(), table("Apple|1")), Changes(), (1, 3)),
    ("pick_heat_then_place_in_recep", APPLE, metadata(apple(), table()), HOT, (1, 3)),
    ("pick_heat_then_place_in_recep", APPLE, metadata(apple(), table("Apple|1")), HOT, (3, 3)),
    ("pick_heat_then_place_in_recep", SLICED, metadata(*map(apple, PIECES), table(PIECES[0])), HOT, (4, 4)),
    ("pick_heat_then_place_in_recep", SLICED, metadata(*map(apple, PIECES), table(PIECES[1])), HOT, (3, 4)),
    ("pick_cool_then_place_in_recep", APPLE, metadata(apple(), table("Apple|1")), Changes(cold={"Apple|1"}), (3, 3)),
    ("pick_clean_then_place_in_recep", APPLE, metadata(apple(), table("Apple|1")), Changes(clean={"Apple|1"}), (3, 3)),
    ("pick_clean_then_place_in_recep", APPLE, metadata(apple(), table("Apple|1")), HOT, (1, 3)),
]


@pytest.mark.parametrize(("kind", "targets", "seen", "changes", "expected"), CASES)
def test_conditions_are_counted(kind, targets, seen, changes, expected):
    reached = progress(kind, targets, seen, changes)
    assert (reached.met, reached.total) == expected


def lamp(**flags):
    return thing("DeskLamp|1", toggleable=True, **flags)


@pytest.mark.parametrize(
    ("lit", "held", "met"),
    [
        ({}, (), 0),
        ({}, ("Pencil|1",), 1),
        ({"isToggled": True, "visible": True}, (), 1),
        ({"isToggled": True}, ("Pencil|1",), 1),  # on, but out of sight
        ({"isToggled": True, "visible": True}, ("Pencil|1",), 2),
    ],
)
def test_looking_at_something_needs_it_in_the_hand_and_the_lamp_in_sight(lit, held, met):
    pencil = thing("Pencil|1", pickupable=True)
    reached = progress(
        "look_at_obj_in_light",
        Targets("Pencil", toggle="DeskLamp"),
        metadata(pencil, lamp(**lit), held=held),
        Changes(),
    )
    assert (reached.met, reached.total) == (met, 2)


@pytest.mark.parametrize(
    ("in_box", "on_chair", "met"),
    [((), (), 0), (("KeyChain|1",), (), 1), ((), ("Box|1",), 1), (("KeyChain|1",), ("Box|1",), 3)],
)
def test_a_movable_receptacle_is_placed_with_what_is_in_it(in_box, on_chair, met):
    targets = Targets("KeyChain", "ArmChair", "Box")
    box = thing("Box|1", pickupable=True, receptacle=True, inside=in_box)
    seen = metadata(thing("KeyChain|1", pickupable=True), box, thing("ArmChair|1", receptacle=True, inside=on_chair))
    reached = progress("pick_and_place_with_movable_recep", targets, seen, Changes())
    assert (reached.met, reached.total) == (met, 3)


def test_there_are_conditions_for_every_type():
    assert set(CONDITIONS) == set(TYPES)


@pytest.mark.parametrize(
    ("action", "of", "kind"),
    [
        ("ToggleObjectOn", "Microwave|1", "hot"),
        ("CloseObject", "Fridge|1", "cold"),
        ("ToggleObjectOn", "Faucet|1", "clean"),
    ],
)
def test_only_the_right_action_on_the_right_thing_changes_what_is_in_it(action, of, kind):
    objects = [
        thing("Microwave|1", receptacle=True, inside=("Apple|1",)),
        thing("Fridge|1", receptacle=True, inside=("Apple|2",)),
        thing("Sink|1|SinkBasin", receptacle=True, inside=("Apple|3",), position=(3.0, 0.0, 0.0)),
        thing("Bathtub|1|BathtubBasin", receptacle=True, inside=("Apple|4",)),
        thing("Faucet|1", toggleable=True),
    ]
    expected = {"hot": "Apple|1", "cold": "Apple|2", "clean": "Apple|3"}
    for name, success in (("Pass", True), ("OpenObject", True), (action, False)):
        changes = Changes()
        changes.follow(metadata(*objects, action=name, success=success), of)
        assert changes == Changes()
    changes.follow(metadata(*objects, action=action), of)
    assert changes == Changes(**{kind: {expected[kind]}})
