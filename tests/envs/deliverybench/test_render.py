"""The picture: right shape, same state same pixels, and what moves is visible."""

from __future__ import annotations

import numpy as np
import pytest

from agentspec.envs.deliverybench.city.generate import generate
from agentspec.envs.deliverybench.view.render import HEIGHT, MAP, SCALE, WAYS, WIDTH, Frame, render
from agentspec.envs.deliverybench.world.engine import World


def pixel(picture: np.ndarray, world: World, point: tuple[float, float]) -> tuple[int, ...]:
    x, y = Frame(world.city)(point)
    return tuple(int(c) for c in picture[round(y / SCALE), round(x / SCALE)])


@pytest.mark.parametrize("size", ["tiny", "small", "medium", "large"])
def test_shape_and_determinism(size: str) -> None:
    world = World(generate(size, 0))
    first = render(world, [])
    assert first.shape == (HEIGHT, WIDTH, 3) and first.dtype == np.uint8
    assert np.array_equal(first, render(world, []))
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 20


def test_the_whole_city_is_in_the_frame() -> None:
    city = generate("large", 1)
    frame = Frame(city)
    points = [frame(p) for poi in city.pois for p in (poi.anchor, poi.center)]
    assert all(0 <= x < MAP * SCALE and 0 <= y < MAP * SCALE for x, y in points)


def test_y_points_up_and_scale_is_even() -> None:
    frame = Frame(generate("tiny", 0))
    (ax, ay), (bx, by), (cx, cy) = frame((0.0, 0.0)), frame((10_000.0, 0.0)), frame((0.0, 10_000.0))
    assert bx > ax and by == ay and cy < ay and cx == ax and bx - ax == pytest.approx(ay - cy)


def test_courier_way_and_orders_are_drawn() -> None:
    world = World(generate("tiny", 0))
    start = world.state.position
    empty = render(world, [])
    assert pixel(empty, world, start) == WAYS["e-scooter"]  # the courier's dot
    world.step("ACCEPT_ORDER([0, 1])")
    assert not np.array_equal(render(world, []), empty)
    world.step("MOVE(17m, 150m)")
    without = render(world, [])
    walked = render(world, [("e-scooter", start), ("e-scooter", world.state.position)])
    assert not np.array_equal(walked, without)
    assert np.array_equal(walked[:, MAP:], without[:, MAP:])  # the panel does not depend on the way


def test_every_state_can_be_drawn() -> None:
    world = World(generate("tiny", 0))
    for action in ('SWITCH(to="walk")', "MOVE(0m, 30m)", "WAIT(4000)"):
        world.step(action)
    steps = [
        ("walk", (0.0, 0.0)),
        ("car", (100.0, 3000.0)),
        ("bus", (2000.0, 100.0)),
        ("drag_scooter", (2000.0, 100.0)),
    ]
    assert render(world, steps).shape == (HEIGHT, WIDTH, 3)
