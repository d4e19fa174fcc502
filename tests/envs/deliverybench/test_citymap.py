"""Compiling the map files: against the reference's ten compiled cities, and on cities small enough to do by hand."""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path

import pytest

from agentspec.envs.deliverybench.city.citymap import City, MapError, build_city, load_city
from agentspec.envs.deliverybench.city.compile import ordinal
from agentspec.envs.deliverybench.city.geometry import box_exit, orientation, project, quarter_turn

REFERENCE = Path(__file__).resolve().parents[3] / ".." / "shared" / "deliverybench"
CITIES = [
    "small-city-11", "small-city-13", "small-city-15", "medium-city-18", "medium-city-20", "medium-city-22",
    "large-city-26", "large-city-28", "large-city-30", "large-city-35",
]  # fmt: skip
# Bus stops diagonally off a corner: two pavements are equally near and the reference's choice follows no rule.
AMBIGUOUS = {
    ("small-city-15", "bus_station 5"),
    ("large-city-30", "bus_station 8"),
    ("large-city-35", "bus_station 2"),
    ("large-city-35", "bus_station 10"),
}

needs_reference = pytest.mark.skipif(
    not (REFERENCE / "maps").is_dir(), reason="the reference cities are not beside the repository (folder shared)"
)


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AGENTSPEC_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def compiled(name: str) -> dict:
    return json.loads((REFERENCE / "compiled" / f"{name}.json").read_text())


def one_road(nodes: list[dict] | None = None) -> City:
    """A single road from (0, 0) to (200, 0) m."""
    roads = {"roads": [{"start": {"x": 0, "y": 0}, "end": {"x": 200, "y": 0}, "is_highway": False}]}
    return build_city("one", roads, {"nodes": nodes or [], "bus_routes": []})


def building(name: str, x: float, y: float, yaw: float, kind: str | None = None) -> dict:
    properties = {
        "location": {"x": x, "y": y, "z": 0},
        "orientation": {"yaw": yaw},
        "bbox": {"x": 1000.0, "y": 2000.0, "z": 1.0},
    }
    if kind:
        properties["poi_type"] = kind
    return {"id": name, "instance_name": "BP_Building_01_C", "properties": properties}


def test_one_road_by_hand() -> None:
    city = one_road()
    # Corners 17 m beside and inside the ends; each 166 m pavement gets waypoints at 50 m and 100 m (3 pieces of >= 50).
    corners = {(1700.0, 1700.0), (18300.0, 1700.0), (18300.0, -1700.0), (1700.0, -1700.0)}
    left = {(6700.0, 1700.0), (11700.0, 1700.0)}
    right = {(13300.0, -1700.0), (8300.0, -1700.0)}
    assert set(city.walk.points) == corners | left | right
    assert Counter(e.kind for e in city.walk.edges) == {"road": 6, "endcap": 2}
    names = dict(zip(city.walk.points, city.walk.names, strict=True))
    assert {names[p] for p in left} == {"1st road (left)"} and {names[p] for p in right} == {"1st road (right)"}
    # Lanes at 10 m: one-way 180 m each, in 3 pieces, and two connectors.
    assert Counter(e.one_way for e in city.drive.edges) == {True: 6, False: 2}


def test_door_and_dock_by_hand() -> None:
    # A house north of the road, yaw 180: its front looks south (180 + 90). Half depth 1.2 * 2000 / 2 = 1200.
    city = one_road([building("a", 5000.0, 4500.0, 180.0, "restaurant"), building("b", 500.0, 4500.0, 180.0)])
    restaurant, beyond = city.pois
    assert restaurant.name == "restaurant 1" and restaurant.json_index == 0 and restaurant.bbox == (1000.0, 2000.0)
    assert restaurant.anchor == (5000.0, 3300.0)
    assert restaurant.dock == (5000.0, 1700.0)
    assert restaurant.road == "1st road (left)"
    # The second lies beyond the pavement's end: its foot on the line is joined to the corner by a piece of its own.
    assert beyond.name == "building 1" and beyond.dock == (500.0, 1700.0)
    assert Counter(e.kind for e in city.walk.edges)["aux_ext"] == 1
    # Pavement from one dock to the other, 45 m, and both ways to the door, 16 m each.
    assert city.door_distance(restaurant, beyond) == pytest.approx(4500.0 + 2 * 1600.0)
    anchors = city.router.anchors
    nodes = city.router.walk.path(anchors[restaurant.id], anchors[beyond.id])
    assert nodes == (restaurant.anchor, restaurant.dock, (1700.0, 1700.0), beyond.dock, beyond.anchor)


def test_nearest_and_near() -> None:
    city = one_road([building("a", 5000.0, 4500.0, 180.0, "store"), building("b", 9000.0, 4500.0, 180.0, "store")])
    found = city.nearest("store", (8000.0, 3300.0))
    assert found is not None and found[0].id == "b" and found[1] == pytest.approx(1000.0)
    assert city.near("store", (8500.0, 3300.0)) is city.poi("store 2")
    assert city.near("store", (8499.0, 3300.0)) is None
    assert city.nearest("hospital", (0.0, 0.0)) is None and city.pois_of("hospital") == ()
    with pytest.raises(KeyError, match="store 9"):
        city.poi("store 9")


def test_geometry() -> None:
    foot = project((5.0, 3.0), (0.0, 0.0), (4.0, 0.0))
    # On the line at x = 5, t = 1.25; the nearest point of the segment is (4, 0): 1 + 9 = 10.
    assert foot.line == (5.0, 0.0) and foot.t == 1.25 and foot.line_sq == 9.0 and foot.segment_sq == pytest.approx(10.0)
    assert [orientation((0, 0), (100.0, y)) for y in (10.0, 11.0)] == ["h", None]  # atan(0.1) = 5.7, atan(0.11) = 6.3
    assert orientation((0, 0), (0.0, -5.0)) == "v"
    assert [quarter_turn(yaw) for yaw in (-90.0, 44.0, 359.0, 180.0)] == [270, 0, 0, 180]
    # A 4 x 2 box turned by 90 degrees is 2 wide: a ray to the east leaves at x = 1, one to the north at y = 2.
    assert box_exit((0.0, 0.0), 4.0, 2.0, 90.0, 0.0) == (1.0, 0.0)
    assert box_exit((0.0, 0.0), 4.0, 2.0, 90.0, 90.0) == (0.0, 2.0)
    assert [ordinal(n) for n in (1, 2, 3, 4, 11, 12, 13, 20, 21, 112)] == [
        "1st", "2nd", "3rd", "4th", "11th", "12th", "13th", "20th", "21st", "112th",
    ]  # fmt: skip


def test_missing_files_are_explained(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"no map folder .*nowhere.*roads\.json.*generate"):
        load_city(tmp_path / "nowhere")
    (tmp_path / "roads.json").write_text('{"roads": []}')
    with pytest.raises(MapError, match=r"no readable progen_world_enriched\.json"):
        load_city(tmp_path)
    (tmp_path / "progen_world_enriched.json").write_text('{"nodes": []}')
    with pytest.raises(MapError, match="lists no roads"):
        load_city(tmp_path)
    (tmp_path / "roads.json").write_text("{")
    with pytest.raises(MapError, match="not JSON"):
        load_city(tmp_path)
    (tmp_path / "roads.json").write_text('{"roads": [{"start": {"x": 0}}]}')
    with pytest.raises(MapError, match="lacks a field"):
        load_city(tmp_path)


@needs_reference
@pytest.mark.parametrize("name", CITIES)
def test_networks_equal_the_reference(name: str) -> None:
    city, truth = load_city(REFERENCE / "maps" / name), compiled(name)
    for network, graph in (("walk", city.walk), ("drive", city.drive)):
        points = [tuple(node[:2]) for node in truth[network]["nodes"]]
        assert set(graph.points) == set(points)
        directed = [(points[e[0]], points[e[1]]) for e in truth[network]["edges"]]
        if network == "walk":
            expected = {
                (frozenset(d), e[2], e[3] if e[2] == "road" else "")
                for d, e in zip(directed, truth[network]["edges"], strict=True)
            }
            got = {(frozenset((graph.points[e.u], graph.points[e.v])), e.kind, e.name) for e in graph.edges}
        else:
            expected = {d if e[5] else frozenset(d) for d, e in zip(directed, truth[network]["edges"], strict=True)}
            ends = [((graph.points[e.u], graph.points[e.v]), e.one_way) for e in graph.edges]
            got = {pair if one_way else frozenset(pair) for pair, one_way in ends}
        assert got == expected and len(graph.edges) == len(truth[network]["edges"])


@needs_reference
@pytest.mark.parametrize("name", CITIES)
def test_places_equal_the_reference(name: str) -> None:
    city, truth = load_city(REFERENCE / "maps" / name), compiled(name)
    for poi, expected in zip(city.pois, truth["pois"], strict=True):
        assert (poi.kind, poi.name) == (expected["type"], expected["name"])
        assert math.dist(poi.center, expected["center"]) < 1e-3
        assert list(poi.dock) == expected["dock"]
        assert list(poi.anchor) == (expected["door"] or list(poi.center))
        if (name, poi.name) not in AMBIGUOUS:
            assert poi.road == expected["road_name"], poi.name


@needs_reference
@pytest.mark.parametrize("name", CITIES)
def test_bus_line_equals_the_reference(name: str) -> None:
    bus, truth = load_city(REFERENCE / "maps" / name).bus, compiled(name)["bus"]
    assert bus.id == truth["route"]
    assert bus.stop_names == tuple(stop[0] for stop in truth["stops"])
    assert [[round(x, 6), round(y, 6)] for x, y in bus.points] == truth["path_points"]
