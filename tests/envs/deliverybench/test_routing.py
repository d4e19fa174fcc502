"""Routes: every sample route of the reference's cities, and properties that hold in any city."""

from __future__ import annotations

import json
import math
import random
from itertools import pairwise
from pathlib import Path

import pytest

from agentspec.envs.deliverybench.city.citymap import City, build_city, load_city
from agentspec.envs.deliverybench.city.generate import generate
from agentspec.envs.deliverybench.city.geometry import polyline_length
from agentspec.envs.deliverybench.city.graph import Edge, Graph, all_pairs, shortest_paths
from agentspec.envs.deliverybench.city.routing import Network
from tests.envs.deliverybench.test_citymap import CITIES, REFERENCE, compiled, needs_reference, one_road


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AGENTSPEC_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@needs_reference
@pytest.mark.parametrize("name", CITIES)
def test_sample_routes_equal_the_reference(name: str) -> None:
    city = load_city(REFERENCE / "maps" / name)
    routes = compiled(name)["routes"]
    assert len(routes) == 60
    for sample in routes:
        route = city.walk_route if sample["mode"] == "walk" else city.car_route
        points = route(tuple(sample["a"]), tuple(sample["b"]))
        assert polyline_length(points) == pytest.approx(sample["length_cm"], abs=1e-3)
        assert len(points) == len(sample["pts"])
        assert all(math.dist(p, q) < 1e-2 for p, q in zip(points, sample["pts"], strict=True))


@needs_reference
@pytest.mark.parametrize("trace", sorted((REFERENCE / "traces").glob("*.json")), ids=lambda p: p.stem)
def test_order_paths_equal_the_reference(trace: Path) -> None:
    episode = json.loads(trace.read_text())
    city = load_city(REFERENCE / "maps" / episode["map"])
    doors = {tuple(round(c, 2) for c in poi.anchor): poi for poi in city.pois}
    orders = list(episode["initial_pool"])
    for step in episode["steps"]:
        orders += step["new_pool_orders"] or []
    for order in orders:
        pickup, dropoff = (doors[tuple(round(100 * c, 2) for c in order[side])] for side in ("pickup_xy", "dropoff_xy"))
        nodes = city.router.walk.path(city.router.anchors[pickup.id], city.router.anchors[dropoff.id])
        assert city.door_distance(pickup, dropoff) / 100 == pytest.approx(order["distance_m"], abs=1e-6)
        assert (pickup.road, dropoff.road) == (order["pickup_road"], order["dropoff_road"])
        assert len(nodes) == len(order["path_xy"])
        assert all(math.dist(p, (100 * x, 100 * y)) < 0.1 for p, (x, y) in zip(nodes, order["path_xy"], strict=True))


def test_route_by_hand() -> None:
    city = one_road()
    # Feet (3000, 1700) and (3000, -1700); round the nearer end: 13 m + 34 m + 13 m along, 3 m + 3 m to and from.
    route = city.walk_route((3000.0, 2000.0), (3000.0, -2000.0))
    assert route == (
        (3000.0, 2000.0), (3000.0, 1700.0), (1700.0, 1700.0), (1700.0, -1700.0), (3000.0, -1700.0), (3000.0, -2000.0),
    )  # fmt: skip
    assert polyline_length(route) == 300.0 + 1300.0 + 3400.0 + 1300.0 + 300.0


def test_two_points_of_one_piece_are_joined_through_its_end() -> None:
    # The reference divides the piece for A first and then joins B to the old ends only: the way passes an end, here the
    # corner (1700, 1700), which lies 3 m + 8 m away, not the direct 5 m.
    route = one_road().walk_route((2000.0, 1700.0), (2500.0, 1700.0))
    assert route == ((2000.0, 1700.0), (1700.0, 1700.0), (2500.0, 1700.0))


def test_car_keeps_to_one_way_lanes() -> None:
    city = one_road()
    # The left lane (y = +10 m) runs east, the right lane west. The ways between anchor and lane are walk routes, here
    # from a point on the lane to itself over the nearest pavement: 2 x 3 m (end of the road) and 2 x 7 m (beside it).
    detours = 600.0 + 1400.0
    east = city.car_route((2000.0, 1000.0), (16000.0, 1000.0))
    assert polyline_length(east) == pytest.approx(14000.0 + detours)
    # Westwards over the right lane: on to the end (16000 -> 19000), 20 m across, 180 m back, 20 m across, 10 m on.
    west = city.car_route((16000.0, 1000.0), (2000.0, 1000.0))
    assert polyline_length(west) == pytest.approx(3000.0 + 2000.0 + 18000.0 + 2000.0 + 1000.0 + detours)


def test_equal_ways_are_broken_by_position() -> None:
    # A square: from (0, 0) to (1, 1) over (0, 1) or (1, 0), equally long; (0, 1) is settled first as the smaller point.
    points = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0))
    edges = tuple(Edge(u, v, "road", "") for u, v in ((0, 1), (0, 2), (1, 3), (2, 3)))
    graph = Graph.build(points, ("normal",) * 4, ("",) * 4, edges)
    dist, before = shortest_paths(graph, 0)
    assert dist == [0.0, 1.0, 1.0, 2.0] and before[3] == 2
    table = all_pairs(graph)
    assert table[0].tolist()[0] == dist and table[1].tolist()[0] == before
    assert Network(graph).path(0, 3) == Network(graph, None, table).path(0, 3) == ((0.0, 0.0), (0.0, 1.0), (1.0, 1.0))


def plain_route(city: City, a: tuple[float, float], b: tuple[float, float]) -> float:
    """Length of the shortest way by relaxing every street piece until nothing changes (Bellman-Ford)."""
    graph, snaps = city.walk, city.router.walk.snaps
    start, goal = snaps.snap(a), snaps.snap(b)
    dist = [math.inf] * len(graph)
    for node, cost in start.links:
        dist[node] = cost
    changed = True
    while changed:
        changed = False
        for u, arcs in enumerate(graph.arcs):
            for v, cost in arcs:
                if dist[u] + cost < dist[v] - 1e-9:
                    dist[v] = dist[u] + cost
                    changed = True
    between = 0.0 if start.foot == goal.foot else min(dist[node] + cost for node, cost in goal.links)
    return math.dist(a, start.foot) + between + math.dist(goal.foot, b)


@pytest.mark.parametrize("seed", range(3))
def test_routes_are_shortest_and_start_and_end_right(seed: int) -> None:
    city, rng = generate("tiny", seed), random.Random(seed)
    low_x, low_y, high_x, high_y = city.bounds
    for _ in range(40):
        a = (round(rng.uniform(low_x, high_x), 4), round(rng.uniform(low_y, high_y), 4))
        b = rng.choice(city.pois).anchor
        route = city.walk_route(a, b)
        assert route[0] == a and route[-1] == b
        assert all(p != q for p, q in pairwise(route))
        assert polyline_length(route) == pytest.approx(plain_route(city, a, b), abs=1e-2)
        assert city.walk_route(a, b) is route
        drive = city.car_route(a, b)
        assert drive[0] == a and drive[-1] == b


def test_tables_and_searches_agree(tmp_path: Path) -> None:
    from agentspec.envs.deliverybench.city.generate import write_city

    searched, tabled = generate("small", 3), load_city(write_city(tmp_path / "small-3", "small", 3))
    assert tabled.router.walk.table is not None and searched.router.walk.table is None
    rng = random.Random(0)
    for _ in range(50):
        a, b = rng.choice(searched.pois).anchor, rng.choice(searched.pois).center
        assert searched.walk_route(a, b) == tabled.walk_route(a, b)
        assert searched.car_route(a, b) == tabled.car_route(a, b)


def test_distance_field_matches_routes() -> None:
    city = generate("tiny", 5)
    home = city.pois[0]
    p = home.dock
    field = city.distances_from(p)
    leg = math.dist(home.anchor, home.dock)
    assert field.to(home) == pytest.approx(leg)
    for poi in city.pois[1:]:
        # A door is a dead end: the way out of it is the leg to its dock, then the way from there.
        assert field.to(poi) == pytest.approx(city.door_distance(home, poi) - leg, abs=1e-6)
    assert field.gap == 0.0 and city.distances_from((p[0], p[1])) is field


@pytest.mark.parametrize("point", [(1e300, -1e300), (math.inf, 0.0), (1e9, 5.0)])
def test_absurd_targets_have_routes(point: tuple[float, float]) -> None:
    route = one_road().walk_route((0.0, 0.0), point)
    assert route[0] == (0.0, 0.0) and route[-1] == point


def test_nan_is_refused() -> None:
    with pytest.raises(ValueError, match="must be numbers"):
        one_road().walk_route((0.0, 0.0), (math.nan, 0.0))


def test_unconnected_streets_give_a_straight_line() -> None:
    far = [{"start": {"x": x, "y": 0}, "end": {"x": x + 200, "y": 0}} for x in (0, 5000)]
    city = build_city("two", {"roads": far}, {"nodes": [], "bus_routes": []})
    assert city.walk_route((5000.0, 0.0), (510000.0, 0.0)) == ((5000.0, 0.0), (510000.0, 0.0))
    assert city.car_route((5000.0, 0.0), (510000.0, 0.0)) == ((5000.0, 0.0), (510000.0, 0.0))
