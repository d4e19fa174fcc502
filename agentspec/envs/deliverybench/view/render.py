"""The map as a picture: streets, places, the courier's way and orders, and a panel with clock, levels and legend.

The part that never changes (streets, buildings, places, bus line) is drawn once per city at twice the size and kept; a
frame copies it, draws the moving parts and halves the size, which smooths every line. A frame takes some milliseconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from agentspec.envs.deliverybench.city.citymap import City, Poi
from agentspec.envs.deliverybench.world.engine import World
from agentspec.envs.deliverybench.world.state import OrderState

HEIGHT, WIDTH = 480, 720
MAP = 480
SCALE = 2
MARGIN_PX = 14
PIN_IDS = 3
ROAD_CM, PAVEMENT_CM = 2000.0, 3600.0

Point = tuple[float, float]
Color = tuple[int, int, int]
Step = tuple[str, Point]

GROUND, PAVEMENT, ROAD, LINE, HOUSE = (
    (236, 239, 230),
    (214, 214, 208),
    (250, 250, 248),
    (225, 222, 205),
    (204, 200, 190),
)
INK, SOFT, WHITE = (38, 42, 48), (120, 124, 130), (255, 255, 255)
KINDS: dict[str, tuple[Color, str]] = {
    "restaurant": ((226, 106, 74), "restaurant"),
    "store": ((64, 134, 200), "store"),
    "rest_area": ((112, 166, 84), "rest area"),
    "hospital": ((206, 62, 92), "hospital"),
    "car_rental": ((150, 108, 190), "car rental"),
    "charging_station": ((240, 180, 40), "charger"),
    "bus_station": ((50, 160, 160), "bus stop"),
}
WAYS: dict[str, Color] = {
    "walk": (90, 90, 90),
    "e-scooter": (30, 120, 230),
    "drag_scooter": (160, 120, 60),
    "car": (150, 60, 190),
    "bus": (40, 150, 150),
}
PICKUP_COLOR, DROPOFF_COLOR, COURIER_COLOR = (226, 106, 74), (70, 60, 160), (20, 24, 30)

_bases: WeakKeyDictionary[City, Image.Image] = WeakKeyDictionary()


class Frame:
    """World coordinates (cm, y up) to pixels of the doubled map image (y down), the whole city in view."""

    def __init__(self, city: City) -> None:
        low_x, low_y, high_x, high_y = city.bounds
        pad = PAVEMENT_CM / 2.0
        span = max(high_x - low_x, high_y - low_y) + 2.0 * pad
        self.factor = (MAP - 2 * MARGIN_PX) * SCALE / span
        self._x = (low_x + high_x) / 2.0
        self._y = (low_y + high_y) / 2.0

    def __call__(self, point: Point) -> Point:
        half = MAP * SCALE / 2.0
        return (half + (point[0] - self._x) * self.factor, half - (point[1] - self._y) * self.factor)

    def length(self, cm: float) -> int:
        """Pixels of a length, at least 1."""
        return max(1, round(cm * self.factor))


def render(world: World, route_walked: Sequence[Step] = ()) -> npt.NDArray[np.uint8]:
    """The picture of a world, uint8 (480, 720, 3).

    Args:
        world: what to show.
        route_walked: where the courier has been, in order: (mode of travel, position in cm); the first is the start.
    """
    frame = Frame(world.city)
    base = _bases.get(world.city)
    if base is None:
        base = _bases[world.city] = _draw_city(world.city, frame)
    picture = base.copy()
    draw = ImageDraw.Draw(picture)
    _draw_way(draw, frame, world.city, route_walked)
    _draw_orders(draw, frame, world.state.orders.values())
    _draw_courier(draw, frame, world)
    result = Image.new("RGB", (WIDTH, HEIGHT), WHITE)
    result.paste(picture.reduce(SCALE), (0, 0))
    _draw_panel(ImageDraw.Draw(result), world)
    return np.asarray(result, dtype=np.uint8)


# -- what never changes ------------------------------------------------------------------------------------------------


def _draw_city(city: City, frame: Frame) -> Image.Image:
    picture = Image.new("RGB", (MAP * SCALE, MAP * SCALE), GROUND)
    draw = ImageDraw.Draw(picture)
    for width, color in ((PAVEMENT_CM, PAVEMENT), (ROAD_CM, ROAD)):
        for road in city.roads:
            _strip(draw, frame, (road.start, road.end), (width, color))
    for road in city.roads:
        draw.line([frame(road.start), frame(road.end)], fill=LINE, width=SCALE)
    if len(city.bus.path) > 1:
        _dashed(draw, [frame(p) for p in city.bus.path], KINDS["bus_station"][0])
    for poi in city.pois:
        if poi.bbox != (0.0, 0.0):
            color = KINDS[poi.kind][0] if poi.kind in KINDS else HOUSE
            draw.polygon([frame(corner) for corner in _corners(poi)], fill=color)
    for poi in city.pois:
        if poi.kind in KINDS:
            _draw_place(draw, frame, poi)
    return picture


def _strip(draw: ImageDraw.ImageDraw, frame: Frame, ends: tuple[Point, Point], style: tuple[float, Color]) -> None:
    """A road of some width whose ends overlap the next road's, so that corners are filled."""
    (ax, ay), (bx, by) = (frame(end) for end in ends)
    width, color = style
    half = frame.length(width) / 2.0
    length = math.hypot(bx - ax, by - ay) or 1.0
    ux, uy = (bx - ax) / length * half, (by - ay) / length * half
    ax, ay, bx, by = ax - ux, ay - uy, bx + ux, by + uy
    draw.polygon([(ax - uy, ay + ux), (bx - uy, by + ux), (bx + uy, by - ux), (ax + uy, ay - ux)], fill=color)


def _dashed(draw: ImageDraw.ImageDraw, points: Sequence[Point], color: Color, dash: float = 12.0) -> None:
    for (ax, ay), (bx, by) in pairwise(points):
        length = math.hypot(bx - ax, by - ay)
        for k in range(int(length / dash / 2.0)):
            s, e = 2.0 * k * dash / length, (2.0 * k + 1.0) * dash / length
            ends = [(ax + (bx - ax) * s, ay + (by - ay) * s), (ax + (bx - ax) * e, ay + (by - ay) * e)]
            draw.line(ends, fill=color, width=SCALE)


def _corners(poi: Poi) -> list[Point]:
    turn = math.radians(poi.yaw)
    cos, sin = math.cos(turn), math.sin(turn)
    half_x, half_y = poi.bbox[0] / 2.0, poi.bbox[1] / 2.0
    box = ((-half_x, -half_y), (half_x, -half_y), (half_x, half_y), (-half_x, half_y))
    return [(poi.center[0] + x * cos - y * sin, poi.center[1] + x * sin + y * cos) for x, y in box]


def _draw_place(draw: ImageDraw.ImageDraw, frame: Frame, poi: Poi) -> None:
    color = KINDS[poi.kind][0]
    x, y = frame(poi.anchor)
    if poi.kind in ("charging_station", "bus_station"):
        r = 4 * SCALE
        draw.rounded_rectangle([x - r, y - r, x + r, y + r], radius=2 * SCALE, fill=color, outline=WHITE, width=SCALE)
        draw.text(
            (x, y), "+" if poi.kind == "charging_station" else "B", fill=WHITE, anchor="mm", font=_font(6 * SCALE)
        )
        return
    _dot(draw, (x, y), 3 * SCALE, color)
    letter = KINDS[poi.kind][1][0].upper()
    draw.text(frame(poi.center), letter, fill=WHITE, anchor="mm", font=_font(7 * SCALE))


# -- what moves --------------------------------------------------------------------------------------------------------


def _draw_way(draw: ImageDraw.ImageDraw, frame: Frame, city: City, steps: Sequence[Step]) -> None:
    """The way so far; between two stops along the streets, older legs paler."""
    count = len(steps) - 1
    for k, ((_, start), (mode, end)) in enumerate(pairwise(steps)):
        way = (
            city.car_route(start, end)
            if mode == "car"
            else (start, end)
            if mode == "bus"
            else city.walk_route(start, end)
        )
        share = 0.35 + 0.65 * (k + 1) / count
        color = _blend(GROUND, WAYS.get(mode, INK), share)
        draw.line([frame(p) for p in way], fill=color, width=3 * SCALE, joint="curve")
    if steps:
        _dot(draw, frame(steps[0][1]), 3 * SCALE, SOFT)


def _draw_orders(draw: ImageDraw.ImageDraw, frame: Frame, orders: Iterable[OrderState]) -> None:
    """A pin at every pick-up and drop-off; orders of one restaurant or door share theirs."""
    pins: dict[tuple[Point, Color], list[int]] = {}
    for order in orders:
        offer = order.offer
        if order.picked is None:
            ends = [frame(offer.pickup.anchor), frame(offer.dropoff.anchor)]
            draw.line(ends, fill=_blend(GROUND, PICKUP_COLOR, 0.5), width=SCALE)
            pins.setdefault((offer.pickup.anchor, PICKUP_COLOR), []).append(offer.id)
        pins.setdefault((offer.dropoff.anchor, DROPOFF_COLOR), []).append(offer.id)
    for (place, color), numbers in pins.items():
        shown = " ".join(str(n) for n in sorted(numbers)[:PIN_IDS])
        _pin(draw, frame(place), color, shown + (f" +{len(numbers) - PIN_IDS}" if len(numbers) > PIN_IDS else ""))


def _pin(draw: ImageDraw.ImageDraw, tip: Point, color: Color, text: str) -> None:
    """A pin with its point at `tip` and a head as wide as the text, kept inside the map."""
    x, y = tip
    r = 8 * SCALE
    half = max(float(r), draw.textlength(text, font=_font(8 * SCALE)) / 2.0 + 4 * SCALE)
    middle = min(max(x, half + SCALE), MAP * SCALE - half - SCALE)
    top = y - 2.1 * r if y > 3.2 * r else y + 2.1 * r
    base = top + 0.5 * r if top < y else top - 0.5 * r
    draw.polygon([(x, y), (x - 0.8 * r, base), (x + 0.8 * r, base)], fill=color)
    head = [middle - half, top - r, middle + half, top + r]
    draw.rounded_rectangle(head, radius=r, fill=color, outline=WHITE, width=SCALE)
    draw.text((middle, top), text, fill=WHITE, anchor="mm", font=_font(8 * SCALE))


def _draw_courier(draw: ImageDraw.ImageDraw, frame: Frame, world: World) -> None:
    state = world.state
    for park, color in ((state.scooter.park, WAYS["e-scooter"]), (state.car.park if state.car else None, WAYS["car"])):
        if park is not None:
            x, y = frame(park)
            r = 4 * SCALE
            draw.rectangle([x - r, y - r, x + r, y + r], fill=color, outline=WHITE, width=SCALE)
    x, y = frame(state.position)
    yaw = math.radians(state.yaw)
    r = 7 * SCALE
    nose = (x + 1.7 * r * math.cos(yaw), y - 1.7 * r * math.sin(yaw))
    sides = [(x + 0.8 * r * math.cos(yaw + a), y - 0.8 * r * math.sin(yaw + a)) for a in (1.57, -1.57)]
    draw.polygon([nose, *sides], fill=COURIER_COLOR)
    draw.ellipse([x - r, y - r, x + r, y + r], fill=WAYS.get(state.mode, INK), outline=COURIER_COLOR, width=2 * SCALE)


# -- the panel ---------------------------------------------------------------------------------------------------------


def _draw_panel(draw: ImageDraw.ImageDraw, world: World) -> None:
    state, left = world.state, MAP + 14
    clock, shift = int(world.seconds), int(world.shift_hours * 3600)
    draw.rectangle([MAP, 0, WIDTH, HEIGHT], fill=WHITE)
    draw.text((left, 10), f"{clock // 3600:d}:{clock // 60 % 60:02d}:{clock % 60:02d}", fill=INK, font=_font(22))
    draw.text((WIDTH - 14, 17), f"of {shift // 60} min", fill=SOFT, anchor="ra", font=_font(11))
    earned = state.balance - world.rules.initial_balance
    draw.text((left, 38), f"{'+' if earned >= 0 else '-'}${abs(earned):.2f}", fill=_gain(earned), font=_font(18))
    draw.text((WIDTH - 14, 44), f"{len(state.settlements)} delivered", fill=SOFT, anchor="ra", font=_font(11))
    draw.text((left, 64), _travelling(world), fill=INK, font=_font(12))
    _bar(draw, 84, "battery", state.scooter.battery, (240, 180, 40))
    _bar(draw, 102, "energy", state.energy, (112, 166, 84))
    draw.text((left, 124), f"orders ({len(state.orders)})", fill=SOFT, font=_font(11))
    draw.text((WIDTH - 14, 124), "due in", fill=SOFT, anchor="ra", font=_font(11))
    shown = list(state.orders.values())[:7]
    for row, order in enumerate(shown):
        _order_row(draw, 140 + 21 * row, world, order)
    _legend(draw)


def _travelling(world: World) -> str:
    words = {"walk": "on foot", "e-scooter": "riding the scooter", "drag_scooter": "dragging the scooter"}
    text = words.get(world.state.mode, f"by {world.state.mode}")
    return f"{text}, charging" if world.state.charging is not None else text


def _bar(draw: ImageDraw.ImageDraw, top: int, name: str, value: float, color: Color) -> None:
    left, right = MAP + 66, WIDTH - 52
    draw.text((MAP + 14, top), name, fill=SOFT, font=_font(11))
    draw.rounded_rectangle([left, top + 2, right, top + 12], radius=4, fill=(232, 232, 228))
    filled = left + (right - left) * min(1.0, max(0.0, value / 100.0))
    if filled >= left + 4:
        draw.rounded_rectangle([left, top + 2, filled, top + 12], radius=4, fill=color)
    draw.text((WIDTH - 14, top), f"{value:.0f} %", fill=INK, anchor="ra", font=_font(11))


def _order_row(draw: ImageDraw.ImageDraw, top: int, world: World, order: OrderState) -> None:
    offer, rate = order.offer, world.rules.ticks_per_second
    elapsed = (world.state.tick - order.accepted) / rate
    left_s = offer.limit - elapsed
    picked = order.picked is not None
    color = DROPOFF_COLOR if picked else PICKUP_COLOR
    draw.rounded_rectangle([MAP + 14, top, MAP + 38, top + 16], radius=5, fill=color)
    draw.text((MAP + 26, top + 8), str(offer.id), fill=WHITE, anchor="mm", font=_font(10))
    status = ("in hand" if order.pending else "in bag") if picked else ("ready" if elapsed >= offer.prep else "cooking")
    draw.text((MAP + 44, top + 2), f"{status}, ${offer.pay:.2f}", fill=INK, font=_font(11))
    late = (206, 62, 92) if left_s < 0 else SOFT
    left = f"{math.ceil(abs(left_s) / 60.0)} min{' late' if left_s < 0 else ''}"
    draw.text((WIDTH - 14, top + 2), left, fill=late, anchor="ra", font=_font(11))


def _legend(draw: ImageDraw.ImageDraw) -> None:
    top = HEIGHT - 158
    rows: list[tuple[Color, str]] = [*KINDS.values(), (HOUSE, "building")]
    draw.line([MAP + 14, top - 8, WIDTH - 14, top - 8], fill=(228, 228, 224), width=1)
    for i, (color, text) in enumerate(rows):
        x, y = MAP + 14 + 112 * (i % 2), top + 18 * (i // 2)
        draw.rounded_rectangle([x, y + 1, x + 11, y + 12], radius=3, fill=color)
        draw.text((x + 17, y), text, fill=INK, font=_font(11))
    pins: Sequence[tuple[Color, str]] = ((PICKUP_COLOR, "pick-up"), (DROPOFF_COLOR, "drop-off"))
    for i, (color, text) in enumerate(pins):
        x, y = MAP + 14 + 112 * i, top + 76
        draw.ellipse([x, y + 1, x + 11, y + 12], fill=color)
        draw.text((x + 17, y), text, fill=INK, font=_font(11))
    for i, (mode, color) in enumerate(WAYS.items()):
        x, y = MAP + 14 + 112 * (i % 2), top + 96 + 17 * (i // 2)
        draw.line([x, y + 7, x + 12, y + 7], fill=color, width=3)
        draw.text(
            (x + 17, y), {"drag_scooter": "dragging", "walk": "on foot"}.get(mode, mode), fill=INK, font=_font(11)
        )


# -- small things ------------------------------------------------------------------------------------------------------


def _dot(draw: ImageDraw.ImageDraw, at: Point, r: float, color: Color) -> None:
    draw.ellipse([at[0] - r, at[1] - r, at[0] + r, at[1] + r], fill=color, outline=WHITE, width=SCALE)


def _blend(a: Color, b: Color, share: float) -> Color:
    r, g, c = (round(p + (q - p) * share) for p, q in zip(a, b, strict=True))
    return (r, g, c)


def _gain(amount: float) -> Color:
    return (50, 140, 70) if amount >= 0.0 else (206, 62, 92)


@lru_cache(maxsize=32)
def _font(size: int) -> Any:
    return ImageFont.load_default(size)
