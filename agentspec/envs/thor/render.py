"""What the agent sees, drawn with Pillow: boxes in their type's colour, shaded by the side, nearest last.

A painter's algorithm over the faces of all boxes: faces that look away are dropped, faces that reach behind the camera
are cut at a near plane, the rest is projected and filled, box by box, none before one that it may hide (two boxes that
do not meet are parted by a plane along an axis, which tells). Walls are painted in pieces, so that no three boxes hide
each other in a ring. Of a container that is open the far sides are drawn, so that one sees what is in it. It is a
picture of where things are, not of what they look like.
"""

from __future__ import annotations

import colorsys
import zlib
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from agentspec.envs.thor.protocol import Picture
from agentspec.envs.thor.scene import Scene, Vector
from agentspec.envs.thor.state import State

if TYPE_CHECKING:
    from agentspec.envs.thor.engine import Settings

Floats = npt.NDArray[np.float64]
Colour = tuple[int, int, int]
Box = tuple[Floats, Floats, Colour]
"""Centre and size in metres, and a colour."""

NEAR = 0.05
"""Metres before the camera at which faces are cut."""

SKY: Colour = (236, 236, 230)
FLOOR: tuple[Colour, Colour] = ((176, 152, 124), (166, 142, 114))
WALLS: Colour = (214, 208, 196)

# corners of a box in units of its half size, and its six faces as corners in order, with their normals
_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) / 2
_FACES = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
_NORMALS = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)], float)
_SHADE = (0.80, 0.80, 0.55, 1.0, 0.90, 0.90)

TINTS: dict[str, Colour] = {
    "Apple": (200, 40, 40), "Bread": (196, 140, 70), "Tomato": (220, 60, 40), "Potato": (170, 130, 80),
    "Lettuce": (90, 170, 70), "Egg": (240, 225, 190), "Fridge": (190, 200, 208), "Microwave": (90, 92, 98),
    "CounterTop": (150, 120, 100), "Sofa": (90, 110, 160), "Bed": (150, 120, 170), "Desk": (140, 100, 60),
    "DiningTable": (150, 106, 60), "Dresser": (120, 84, 52), "HousePlant": (60, 140, 70), "BasketBall": (230, 120, 30),
    "GarbageCan": (80, 90, 90), "Television": (30, 30, 36), "Laptop": (60, 64, 72), "Pillow": (230, 220, 200),
    "Mug": (60, 120, 190), "SinkBasin": (120, 128, 134), "Faucet": (200, 205, 210), "DeskLamp": (240, 210, 90),
    "FloorLamp": (240, 210, 90), "Box": (180, 140, 90), "ArmChair": (120, 140, 110),
}  # fmt: skip


@lru_cache(maxsize=512)
def tint(type_name: str) -> Colour:
    """A type's colour: a chosen one, else one that follows from the name."""
    base = type_name.removesuffix("Sliced").removesuffix("Cracked")
    if base in TINTS:
        return TINTS[base]
    code = zlib.crc32(base.encode())
    r, g, b = colorsys.hsv_to_rgb((code % 360) / 360, 0.35 + (code >> 9) % 30 / 100, 0.6 + (code >> 16) % 30 / 100)
    return round(r * 255), round(g * 255), round(b * 255)


def draw(scene: Scene, state: State, settings: Settings) -> Picture:
    """The egocentric picture, uint8 (height, width, 3)."""
    size = (settings.width, settings.height)
    image = Image.new("RGB", size, SKY)
    canvas = ImageDraw.Draw(image)
    eye, turn = settings.camera.eye(state.agent), settings.camera.turn(state.agent)
    focal = settings.height / 2 / settings.camera.half
    _floor(canvas, scene, eye, turn, focal, size)
    walls = [(c, s, WALLS) for c, s in pieces(scene.walls)]
    shut = {b.id for b in state.bodies.values() if b.closed or b.held}
    shown = [
        b for b in state.bodies.values() if not b.held and b.type != "Floor" and not any(p in shut for p in b.parents)
    ]
    boxes = [(np.array(b.centre), np.array(b.size), _colour(b.type, b.on)) for b in shown]
    number = {b.id: len(walls) + i for i, b in enumerate(shown)}
    hollow = [number[b.id] for b in shown if b.open and {"openable", "receptacle"} <= set(b.abilities)]
    inside = [(number[b.id], number[p]) for b in shown for p in b.parents if number.get(p) in hollow]
    for polygon, colour, line in _faces(walls + boxes, hollow, inside, eye, turn, focal, size):
        canvas.polygon(polygon, fill=colour, outline=line)
    return np.asarray(image)


@lru_cache(maxsize=64)
def pieces(walls: tuple[tuple[Vector, Vector], ...]) -> tuple[tuple[Floats, Floats], ...]:
    """Walls as centres and sizes of pieces about 1 m long."""
    made = []
    for c, s in walls:
        axis = 0 if s[0] >= s[2] else 2
        count = max(1, round(s[axis]))
        for i in range(count):
            centre, length = np.array(c), np.array(s)
            centre[axis] += s[axis] * ((i + 0.5) / count - 0.5)
            length[axis] = s[axis] / count
            made.append((centre, length))
    return tuple(made)


def _colour(type_name: str, on: bool) -> Colour:
    r, g, b = tint(type_name)
    return (min(255, r + 60), min(255, g + 60), min(255, b + 20)) if on else (r, g, b)


def _dark(colour: Colour) -> Colour:
    return colour[0] * 7 // 10, colour[1] * 7 // 10, colour[2] * 7 // 10


def _faces(
    boxes: list[Box],
    hollow: list[int],
    inside: list[tuple[int, int]],
    eye: Floats,
    turn: Floats,
    focal: float,
    size: tuple[int, int],
) -> list[tuple[list[tuple[float, float]], Colour, Colour]]:
    """Polygons in pixels with their colours and those of their outlines, far to near.

    Args:
        boxes: all of them.
        hollow: numbers of those that are open.
        inside: (number of a box, number of the open one that it is in).
        eye, turn: of the camera.
        focal: its focal length, pixels.
        size: of the picture.
    """
    if not boxes:
        return []
    centres, sizes = np.array([b[0] for b in boxes]), np.array([b[1] for b in boxes])
    corners = centres[:, None] + _CORNERS * sizes[:, None]
    local = (corners - eye) @ turn.T
    middles = centres[:, None] + _NORMALS / 2 * sizes[:, None]
    facing = ((eye - middles) * _NORMALS).sum(-1) > 0
    facing[hollow] = ~facing[hollow]
    facing &= (local[..., 2].max(axis=1) > NEAR)[:, None]
    # the point of a box nearest to the camera decides which box is in front; within a box, the face's middle
    nearest = np.linalg.norm(np.clip(eye, centres - sizes / 2, centres + sizes / 2) - eye, axis=1)
    spans = np.linalg.norm(centres - eye, axis=1)
    rank = _in_front(0.5 * nearest + 0.5 * spans, centres, sizes, hollow, inside)
    shown = np.flatnonzero(facing.any(axis=1) & _in_picture(local, focal, size))
    far = np.linalg.norm(middles - eye, axis=2)
    found = []
    for i in shown[_order(centres[shown], sizes[shown], eye, rank[shown])]:
        for f in sorted(np.flatnonzero(facing[i]), key=lambda f: -far[i, f]):
            polygon = _project(local[i, _FACES[f]], focal, size)
            if polygon:
                r, g, b = boxes[i][2]
                s = _SHADE[f]
                colour = (int(r * s), int(g * s), int(b * s))
                # the seams between pieces of a wall are not drawn
                line = colour if boxes[i][2] == WALLS else _dark(colour)
                found.append((polygon, colour, line))
    return found


def _in_picture(local: Floats, focal: float, size: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Which boxes are not wholly to one side of the picture; `local` are corners in camera coordinates, (n, 8, 3)."""
    ahead = np.maximum(local[..., 2], 0.0)
    wide, high = ahead * size[0] / 2 / focal, ahead * size[1] / 2 / focal
    beside = (local[..., 0] > wide).all(1) | (local[..., 0] < -wide).all(1)
    return np.asarray(~(beside | (local[..., 1] > high).all(1) | (local[..., 1] < -high).all(1)))


def _order(centres: Floats, sizes: Floats, eye: Floats, rank: Floats) -> list[int]:
    """The numbers of boxes so that none comes before one that it may hide; by `rank`, large first, where that is open.

    A box cannot hide another one from which a plane along an axis parts it, if the eye is not on its own side of it.
    """
    low, high = centres - sizes / 2, centres + sizes / 2
    above = (low[:, None] >= high[None] - 0.01) & (eye <= low + 0.01)[:, None]
    below = (high[:, None] <= low[None] + 0.01) & (eye >= high - 0.01)[:, None]
    harmless = np.asarray((above | below).any(axis=2))  # [i, j]: i cannot hide j
    first = harmless & ~harmless.T
    waiting = first.sum(axis=0)
    left = np.ones(len(rank), bool)
    order = []
    for _ in range(len(rank)):
        free = left & (waiting == 0)
        best = int(np.argmax(np.where(free if free.any() else left, rank, -np.inf)))
        order.append(best)
        left[best] = False
        waiting -= first[best]
    return order


def _in_front(rank: Floats, centres: Floats, sizes: Floats, hollow: list[int], inside: list[tuple[int, int]]) -> Floats:
    """Ranks (larger is painted earlier) with open containers after the furniture they are part of, and before what they
    hold."""
    held = {i for i, _ in inside}
    for k in hollow:
        meets = (np.abs(centres - centres[k]) <= (sizes + sizes[k]) / 2 + 0.02).all(axis=1)
        meets[[k, *held]] = False
        rank[k] = min(rank[k], rank[meets].min(initial=np.inf)) - 1e-3
    for i, k in inside:
        rank[i] = min(rank[i], rank[k] - 1e-3)
    return rank


def _project(points: Floats, focal: float, size: tuple[int, int]) -> list[tuple[float, float]]:
    """A face (4, 3) in camera coordinates as a polygon in pixels, cut at the near plane; empty if nothing is left."""
    if points[:, 2].min() < NEAR:
        points = _cut(points)
        if len(points) < 3:
            return []
    x = size[0] / 2 + focal * points[:, 0] / points[:, 2]
    y = size[1] / 2 - focal * points[:, 1] / points[:, 2]
    if x.max() < 0 or y.max() < 0 or x.min() > size[0] or y.min() > size[1]:
        return []
    return list(zip(x.tolist(), y.tolist(), strict=True))


def _cut(points: Floats) -> Floats:
    """The part of a polygon beyond the near plane (Sutherland and Hodgman, 1974, for one plane)."""
    kept = []
    for a, b in zip(points, np.roll(points, -1, axis=0), strict=True):
        if a[2] >= NEAR:
            kept.append(a)
        if (a[2] >= NEAR) != (b[2] >= NEAR):
            kept.append(a + (b - a) * ((NEAR - a[2]) / (b[2] - a[2])))
    return np.array(kept).reshape(-1, 3)


def _floor(
    canvas: ImageDraw.ImageDraw, scene: Scene, eye: Floats, turn: Floats, focal: float, size: tuple[int, int]
) -> None:
    """The floor as a chequered plane of 1 m tiles."""
    west, south, east, north = scene.area
    for i in range(int(np.floor(west)), int(np.ceil(east))):
        for j in range(int(np.floor(south)), int(np.ceil(north))):
            tile = np.array([(i, 0, j), (i, 0, j + 1), (i + 1, 0, j + 1), (i + 1, 0, j)], float)
            local = (tile - eye) @ turn.T
            if local[:, 2].max() > NEAR:
                polygon = _project(local, focal, size)
                if polygon:
                    canvas.polygon(polygon, fill=FLOOR[(i + j) % 2])
