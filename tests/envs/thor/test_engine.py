"""The offline player: moves, visibility, what can be done to objects, failures, exact snapshots, pictures."""

from __future__ import annotations

import random

import numpy as np
import pytest

from agentspec.envs.thor.engine import OfflineThor, Settings
from agentspec.envs.thor.geodesic import corners, distances, straight
from agentspec.envs.thor.render import tint
from agentspec.envs.thor.scene import Scene, object_id, thing

# five by five cells, 1 m x 1 m; a fridge to the north, an apple on a table to the east
CELLS = frozenset((i, j) for i in range(5) for j in range(5))
FRIDGE = thing("Fridge", (0.5, 0.0, 1.8), size=(0.8, 1.7, 0.6))
TABLE = thing("DiningTable", (1.8, 0.0, 0.5), size=(0.8, 0.7, 0.8))
APPLE = thing("Apple", (1.7, 0.7, 0.5))
KNIFE = thing("Knife", (1.7, 0.7, 0.2))
EGG = thing("Egg", (0.5, 0.6, 1.8))


def world(**settings) -> OfflineThor:
    made = OfflineThor(Scene("Test1", CELLS, (FRIDGE, TABLE, APPLE, KNIFE, EGG)), Settings(**settings))
    made.step({"action": "TeleportFull", "x": 0.5, "z": 0.5, "rotation": 90, "horizon": 30})
    return made


def act(w: OfflineThor, action: str, **fields):
    return w.step({"action": action, **fields})


def test_moves_go_where_the_agent_looks_and_stop_at_the_edge():
    w = world()
    assert act(w, "MoveAhead").metadata["agent"]["position"]["x"] == pytest.approx(0.75)
    assert act(w, "MoveAhead").success
    blocked = act(w, "MoveAhead")  # x = 1.25 is no cell
    assert not blocked.success and "blocks" in blocked.error and blocked.metadata["collided"]
    assert blocked.metadata["agent"]["position"]["x"] == pytest.approx(1.0)
    assert act(w, "RotateLeft").metadata["agent"]["rotation"]["y"] == 0.0


def test_what_is_shut_away_or_behind_is_not_visible():
    w = world()
    event = act(w, "Pass")
    assert event.thing(APPLE.id)["visible"]
    assert not event.thing(FRIDGE.id)["visible"]  # to the left of the picture
    event = act(w, "RotateLeft")
    assert event.thing(FRIDGE.id)["visible"] and not event.thing(APPLE.id)["visible"]
    assert event.thing(EGG.id)["parentReceptacles"] == [FRIDGE.id]
    assert not event.thing(EGG.id)["visible"]
    assert act(w, "OpenObject", objectId=FRIDGE.id).thing(EGG.id)["visible"]


def test_walls_hide():
    wall = ((1.25, 1.25, 0.5), (0.05, 2.5, 2.0))
    w = OfflineThor(Scene("Test2", CELLS, (TABLE, APPLE), (wall,)))
    event = act(w, "TeleportFull", x=0.5, z=0.5, rotation=90, horizon=30)
    assert not event.thing(APPLE.id)["visible"] and not event.thing(TABLE.id)["visible"]


def test_taking_putting_and_what_fails():
    w = world()
    assert not act(w, "PutObject", objectId=APPLE.id, receptacleObjectId=TABLE.id).success  # nothing in the hand
    event = act(w, "PickupObject", objectId=APPLE.id)
    assert event.success and event.metadata["inventoryObjects"][0]["objectId"] == APPLE.id
    assert event.thing(APPLE.id)["parentReceptacles"] is None
    assert "not empty" in act(w, "PickupObject", objectId=KNIFE.id).error
    act(w, "RotateLeft")
    assert "closed" in act(w, "PutObject", objectId=APPLE.id, receptacleObjectId=FRIDGE.id).error
    assert act(w, "OpenObject", objectId=FRIDGE.id).success
    assert "already" in act(w, "OpenObject", objectId=FRIDGE.id).error
    event = act(w, "PutObject", objectId=APPLE.id, receptacleObjectId=FRIDGE.id)
    assert event.success and APPLE.id in event.thing(FRIDGE.id)["receptacleObjectIds"]
    assert event.metadata["inventoryObjects"] == []


def test_slicing_needs_a_knife_and_leaves_pieces():
    w = world()
    assert "knife" in act(w, "SliceObject", objectId=APPLE.id).error
    act(w, "PickupObject", objectId=KNIFE.id)
    event = act(w, "SliceObject", objectId=APPLE.id)
    pieces = [o for o in event.metadata["objects"] if o["objectType"] == "AppleSliced"]
    assert event.thing(APPLE.id) is None and len(pieces) == 5
    assert all(o["parentReceptacles"] == [TABLE.id] and o["pickupable"] for o in pieces)
    assert {o["objectId"] for o in pieces} == {f"{APPLE.id}|AppleSliced_{n}" for n in range(1, 6)}
    assert not any(o["sliceable"] for o in pieces) and all(o["isSliced"] for o in pieces)
    assert not act(w, "SliceObject", objectId=APPLE.id).success
    assert not act(w, "SliceObject", objectId=pieces[0]["objectId"]).success


def test_pieces_are_taken_and_put_one_by_one():
    w = world()
    act(w, "PickupObject", objectId=KNIFE.id)
    act(w, "SliceObject", objectId=APPLE.id)
    act(w, "PutObject", objectId=KNIFE.id, receptacleObjectId=TABLE.id)
    one = f"{APPLE.id}|AppleSliced_2"
    assert act(w, "PickupObject", objectId=one).success
    act(w, "RotateLeft")
    act(w, "OpenObject", objectId=FRIDGE.id)
    event = act(w, "PutObject", objectId=one, receptacleObjectId=FRIDGE.id)
    assert event.thing(FRIDGE.id)["receptacleObjectIds"] == [EGG.id, one]


def test_an_egg_is_cracked_without_a_knife():
    w = world()
    act(w, "RotateLeft")
    act(w, "OpenObject", objectId=FRIDGE.id)
    event = act(w, "SliceObject", objectId=EGG.id)
    cracked = event.thing(f"{EGG.id}|EggCracked_1")
    assert event.success and cracked["parentReceptacles"] == [FRIDGE.id] and event.thing(EGG.id) is None


def test_what_is_in_the_hand_or_shut_away_is_not_sliced():
    w = world()
    act(w, "PickupObject", objectId=APPLE.id)
    assert not act(w, "SliceObject", objectId=APPLE.id).success
    assert not act(world(), "SliceObject", objectId=EGG.id).success  # in the closed fridge


@pytest.mark.parametrize(
    ("position", "made"),
    [
        ((-1.835, 0.59083575, 4.12483025), "KeyChain|-01.84|+00.59|+04.12"),
        ((0.0, 1.005, -10.0), "KeyChain|+00.00|+01.00|-10.00"),
    ],
)
def test_ids_round_as_the_simulator_does(position, made):
    assert object_id("KeyChain", position) == made


def test_a_laptop_is_placed_open():
    w = world()
    pose = {"objectName": "Laptop_1", "position": {"x": 1.7, "y": 0.7, "z": 0.5}}
    event = act(w, "SetObjectPoses", objectPoses=[pose])
    laptop = next(o for o in event.metadata["objects"] if o["objectType"] == "Laptop")
    assert laptop["isOpen"]
    assert act(w, "CloseObject", objectId=laptop["objectId"]).success


@pytest.mark.parametrize(
    "action",
    [
        {},
        {"action": "Fly"},
        {"action": "PickupObject"},
        {"action": "PickupObject", "objectId": "Unicorn|1"},
        {"action": "TeleportFull", "x": 99, "z": 0},
        {"action": "TeleportFull", "x": "far"},
        {"action": "SetObjectPoses"},
        {"action": "GetShortestPath", "objectType": "Unicorn"},
        {"action": "Reset", "sceneName": "Elsewhere"},
        {"action": "MoveAhead", "moveMagnitude": "x"},
    ],
    ids=str,
)
def test_what_cannot_be_done_fails_and_changes_nothing(action):
    w = world()
    before = w.state.dump()
    event = w.step(action)
    assert not event.success and event.error
    assert w.state.dump() == before


def test_snapshots_are_identities_under_random_play():
    rng = random.Random(5)
    w, twin = world(), world()
    ids = [t.id for t in w.scene.things]
    names = [
        "MoveAhead",
        "RotateLeft",
        "RotateRight",
        "LookUp",
        "LookDown",
        "PickupObject",
        "OpenObject",
        "SliceObject",
    ]
    for _ in range(120):
        action = {"action": rng.choice(names), "objectId": rng.choice(ids)}
        blob = w.snapshot()
        twin.restore(blob)
        assert twin.snapshot() == blob
        assert w.step(action).metadata == twin.step(action).metadata


def test_a_snapshot_of_another_scene_is_refused():
    other = OfflineThor(Scene("Other", CELLS, ()))
    with pytest.raises(ValueError, match="Other"):
        world().restore(other.snapshot())


def test_setting_poses_makes_copies_and_takes_the_rest_away():
    w = world()
    places = [{"x": 1.6, "y": 0.7, "z": 0.4}, {"x": 1.9, "y": 0.7, "z": 0.7}]
    event = act(w, "SetObjectPoses", objectPoses=[{"objectName": "Apple_1", "position": p} for p in places])
    ids = {o["objectId"] for o in event.metadata["objects"] if o["pickupable"]}
    assert ids == {"Apple|+01.60|+00.70|+00.40", "Apple|+01.90|+00.70|+00.70"}


def test_pictures_show_what_is_there_and_only_that():
    w = world()
    with_apple = act(w, "Pass").frame
    assert with_apple.shape == (300, 300, 3) and with_apple.dtype == np.uint8
    act(w, "PickupObject", objectId=APPLE.id)
    assert (act(w, "Pass").frame != with_apple).any()
    assert (act(w, "Pass").frame == act(w, "Pass").frame).all()


def test_pictures_show_what_stands_on_a_table_and_what_is_in_an_open_fridge():
    w = world()
    ink = np.array(tint("Knife"))
    assert (np.abs(act(w, "Pass").frame - ink).sum(axis=2) < 90).any()  # small, on a large box
    act(w, "RotateLeft")
    shut = act(w, "Pass").frame
    egg = np.array(tint("Egg"))
    before = (np.abs(shut - egg.astype(int)).sum(axis=2) == 0).sum()
    opened = act(w, "OpenObject", objectId=FRIDGE.id).frame
    assert (np.abs(opened - egg.astype(int)).sum(axis=2) == 0).sum() > before


def test_no_box_is_painted_over_one_that_hides_it():
    """A long wall behind a table in a corner, for any heading: the table's pixels stay the table's."""
    table = thing("DiningTable", (1.9, 0.0, 1.0), size=(1.6, 0.7, 0.6))
    wall = ((1.3, 1.25, 1.4), (12.0, 2.5, 0.1))
    with_wall, without = (OfflineThor(Scene("T", CELLS, (table,), walls)) for walls in ((wall,), ()))
    colours = [tuple(int(c * s) for c in tint("DiningTable")) for s in (1.0, 0.9, 0.8)]
    for yaw in (0, 30, 60, 90):
        spot = {"action": "TeleportFull", "x": 0.5, "z": 0.25, "rotation": yaw, "horizon": 30}
        frames = [w.step(spot).frame for w in (with_wall, without)]
        shown = [sum((f == c).all(axis=2).sum() for c in colours) for f in frames]
        assert shown[0] == shown[1] > 0


def test_shortest_ways_are_straight_where_nothing_is_between():
    # 3 cells east and 4 north, free: 5 * 0.25 m
    best, towards = distances([(4, 4)], CELLS)
    assert best[(1, 0)] == pytest.approx(1.25) and corners((1, 0), towards) == [(1, 0), (4, 4)]
    # with the column x = 2 closed but for z = 0, the way from (1, 4) to (3, 4) goes round by (2, 0): 8 cells at least
    walled = CELLS - {(2, j) for j in range(1, 5)}
    best, _ = distances([(3, 4)], walled)
    assert not straight((1, 4), (3, 4), walled)
    assert best[(1, 4)] >= 8 * 0.25
