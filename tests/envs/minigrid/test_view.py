"""Texts say what is in view, where, and nothing that is not."""

from __future__ import annotations

import random

import pytest
from minigrid.core.constants import IDX_TO_COLOR, IDX_TO_OBJECT
from minigrid.core.grid import Grid
from minigrid.core.world_object import Ball, Door, Goal, Key, Lava, Wall

from agentspec.envs.minigrid.env import MiniGridEnv
from agentspec.envs.minigrid.suites import SUITES
from agentspec.envs.minigrid.texts import basic, compact, relational
from agentspec.envs.minigrid.view import Thing, look


def world(*, carrying=None, **cells):
    """A 9 x 9 room; the agent stands at (4, 7) and faces north; `f2_l1=Key("red")` puts a key 2 forward, 1 left."""
    env = MiniGridEnv(level="MiniGrid-Empty-8x8-v0")
    env.reset(seed=0)
    made = env.world
    made.grid = Grid(9, 9)
    made.grid.wall_rect(0, 0, 9, 9)
    made.width = made.height = 9
    made.agent_pos, made.agent_dir, made.carrying = (4, 7), 3, carrying
    made.see_through_walls = False
    made.mission = "fetch the red key"
    for place, thing in cells.items():
        forward, side = place[1:].split("_")
        right = {"l": -1, "r": 1}[side[0]] * int(side[1:])
        made.grid.set(4 + right, 7 - int(forward), thing)
    return made


def test_places_are_steps_from_the_agent_nearest_first():
    view = look(world(f2_l1=Key("red"), f1_r0=Ball("blue"), f0_r2=Goal()))
    assert [(t.name, t.place, t.distance) for t in view.things] == [
        ("blue ball", "1 forward", 1),
        ("goal", "2 right", 2),
        ("red key", "2 forward, 1 left", 3),
    ]
    assert view.heading == "north" and view.ahead.name == "blue ball"
    assert view.affordances == ("pick up",)


def test_affordances_of_the_front_cell():
    assert look(world()).affordances == ("walk",)
    assert look(world(carrying=Key("red"))).affordances == ("walk", "drop")
    assert look(world(f1_r0=Wall())).affordances == ()
    assert look(world(f1_r0=Goal())).affordances == ("walk",)
    assert look(world(f1_r0=Lava())).affordances == ("deadly",)
    assert look(world(f1_r0=Door("red", is_locked=True))).affordances == ("toggle",)
    assert look(world(f1_r0=Door("red", is_open=True))).affordances == ("walk", "toggle")
    assert look(world(f1_r0=Key("red"), carrying=Key("blue"))).affordances == ()


def test_what_a_wall_hides_is_not_described():
    row = {f"f1_{side}": Wall() for side in ("l3", "l2", "l1", "r0", "r1", "r2", "r3")}
    view = look(world(**row, f3_r0=Key("red")))
    assert view.things == () and view.walls[0] == 1
    for text in (compact(view), basic(view), relational(view)):
        assert "key" not in text.replace("fetch the red key", "").replace("K key", "")


def test_walls_are_measured_on_free_rays_only():
    # Ahead a ball hides the wall; 4 cells to the left and right the room ends, beyond the view of 3.
    assert look(world(f1_r0=Ball("red"))).walls == (0, 0, 0)
    assert look(world(f0_l2=Wall(), f0_r3=Wall(), f4_r0=Wall())).walls == (4, 2, 3)


def test_rows_of_lava_are_named_together():
    lava = {f"f2_{side}": Lava() for side in ("l2", "l1", "r1")}
    assert "lava 2 forward, 2 left to 1 left; lava 2 forward, 1 right" in compact(look(world(**lava)))
    column = {f"f{forward}_l1": Lava() for forward in (1, 2, 3)}
    assert "lava 1 to 3 forward, 1 left" in compact(look(world(**column)))


def test_the_map_shows_the_view_from_the_agent():
    rows = look(world(f2_l1=Key("red"), f1_r0=Door("blue", is_open=True), f3_r2=Lava())).rows
    assert rows[-1][3] == "^" and rows[-2][3] == "_" and rows[-3][2] == "K" and rows[-4][5] == "L"


def test_texts_name_what_is_carried_and_what_happened():
    view = look(world(carrying=Key("red")))
    assert "carrying red key" in compact(view, "picked up red key") and "Last: picked up red key." in compact(
        view, "picked up red key"
    )
    assert "You carry a red key." in basic(view)
    assert "Carrying: red key." in relational(view)


def test_feedback_says_what_an_action_did():
    env = MiniGridEnv(level="MiniGrid-Empty-8x8-v0")
    env.reset(seed=0)
    env.world.grid.set(2, 1, Key("red"))  # the agent stands at (1, 1) and faces east
    env.step("TURN_LEFT()")
    env.step("TURN_RIGHT()")
    said = [env.step(f"{action}()")[4]["message"] for action in ("FORWARD", "PICK_UP", "PICK_UP", "DROP", "TOGGLE")]
    assert said == [
        "could not go forward, red key is in the way",
        "picked up red key",
        "picked up nothing, you already carry red key",
        "dropped red key",
        "toggled nothing",
    ]


LEVELS = (
    *(layout for ids in SUITES.values() for layout in ids),
    "MiniGrid-Dynamic-Obstacles-6x6-v0",
    "MiniGrid-KeyCorridorS3R3-v0",
    "MiniGrid-LockedRoom-v0",
    "MiniGrid-ObstructedMaze-Full-v1",
    "MiniGrid-Playground-v0",
    "MiniGrid-UnlockPickup-v0",
    "BabyAI-GoToSeqS5R2-v0",
    "BabyAI-UnlockPickupDist-v0",
)


@pytest.mark.parametrize("level", sorted(set(LEVELS)))
def test_what_is_seen_is_what_minigrid_itself_shows(level):
    """Every cell of the symbolic view, decoded by MiniGrid's own tables, under random play."""
    env, rng = MiniGridEnv(level=level, max_steps=60), random.Random(level)
    env.reset(seed=3)
    types, colours = IDX_TO_OBJECT, IDX_TO_COLOR
    for _ in range(40):
        seen = env.world.gen_obs()["image"]
        view = look(env.world)
        expected = []
        for row in range(7):
            for column in range(7):
                kind, colour, state = (int(v) for v in seen[column, row])
                forward, right = 6 - row, column - 3
                if (forward, right) == (0, 0):
                    continue
                cell = view.cells[forward][column] if forward < len(view.cells) else "unseen"
                assert cell == types[kind]
                if types[kind] not in ("unseen", "empty", "wall", "floor"):
                    word = ("open", "closed", "locked")[state] if types[kind] == "door" else ""
                    expected.append(Thing(types[kind], colours[colour], word, forward, right))
        assert sorted(view.things, key=repr) == sorted(expected, key=repr)
        if env.step(rng.choice(["FORWARD()", "FORWARD()", "TURN_LEFT()", "PICK_UP()", "TOGGLE()", "DROP()"]))[2]:
            break


def test_nothing_of_minigrid_stays_changed_after_a_step():
    env = MiniGridEnv()
    env.reset(seed=0)
    env.step("FORWARD()")
    assert "gen_obs" not in vars(env.world) and env.world.gen_obs()["image"].shape == (7, 7, 3)
