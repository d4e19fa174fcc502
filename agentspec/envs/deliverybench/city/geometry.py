"""Plane geometry in centimetres, rounded to four decimals.

The reference world rounds both coordinates of a vector at construction and after every operation. That rounding
decides which of two collinear streets a door belongs to, so the functions here repeat it step by step instead of
rounding only the result.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

Point = tuple[float, float]

DECIMALS = 4
SNAP_ANGLE_DEG = 6.0


class Foot(NamedTuple):
    """Projection of a point on a segment.

    Attributes:
        line: foot on the infinite line (cm, rounded).
        t: unclamped parameter of the foot, 0 at the first endpoint and 1 at the second.
        line_sq: squared distance to `line` (cm^2).
        segment_sq: squared distance to the nearest point of the segment (cm^2).
    """

    line: Point
    t: float
    line_sq: float
    segment_sq: float


def rounded(x: float, y: float) -> Point:
    """The point (x, y) with both coordinates rounded to four decimals (cm)."""
    return (round(x, DECIMALS), round(y, DECIMALS))


def distance(a: Point, b: Point) -> float:
    """Straight-line distance (cm); the difference vector is rounded first, as every vector is."""
    return math.hypot(round(b[0] - a[0], DECIMALS), round(b[1] - a[1], DECIMALS))


def length(a: Point, b: Point) -> float:
    """Length (cm) of the street piece a-b, unrounded: the last bits decide between equally long ways."""
    return math.hypot(b[0] - a[0], b[1] - a[1])


def along(a: Point, b: Point, t: float) -> Point:
    """The point a + t (b - a), rounded after each vector operation."""
    dx, dy = rounded(b[0] - a[0], b[1] - a[1])
    sx, sy = rounded(dx * t, dy * t)
    return rounded(a[0] + sx, a[1] + sy)


def parameter(p: Point, a: Point, b: Point) -> float:
    """Unclamped parameter of the foot of `p` on the line a-b; 0.0 for a degenerate segment."""
    dx, dy = rounded(b[0] - a[0], b[1] - a[1])
    length_sq = dx * dx + dy * dy
    if length_sq == 0.0:
        return 0.0
    px, py = rounded(p[0] - a[0], p[1] - a[1])
    return (px * dx + py * dy) / length_sq


def project(p: Point, a: Point, b: Point) -> Foot:
    """The foot of `p` on the line and the segment a-b."""
    t = parameter(p, a, b)
    line = along(a, b, t)
    nearest = line if 0.0 <= t <= 1.0 else (a if t < 0.0 else b)
    return Foot(line, t, _distance_sq(p, line), _distance_sq(p, nearest))


def segment_distance(p: Point, a: Point, b: Point) -> float:
    """Distance (cm) from `p` to the segment a-b."""
    return math.sqrt(project(p, a, b).segment_sq)


def orientation(a: Point, b: Point) -> str | None:
    """'h' or 'v' when a-b is within 6 degrees of horizontal or vertical, else None."""
    angle = math.degrees(math.atan2(abs(b[1] - a[1]), abs(b[0] - a[0])))
    if angle <= SNAP_ANGLE_DEG:
        return "h"
    return "v" if angle >= 90.0 - SNAP_ANGLE_DEG else None


def quarter_turn(yaw: float) -> int:
    """The multiple of 90 degrees nearest to `yaw`, one of 0, 90, 180, 270."""
    return round((yaw % 360.0) / 90.0) % 4 * 90


def box_exit(center: Point, width: float, height: float, yaw: float, heading: float) -> Point:
    """Where a ray leaves a rectangle.

    Args:
        center: centre of the rectangle and start of the ray (cm).
        width: extent along the rectangle's own x axis (cm).
        height: extent along its own y axis (cm).
        yaw: rotation of the rectangle (degrees).
        heading: direction of the ray in the world (degrees).
    """
    angle = math.radians(heading)
    dx, dy = math.cos(angle), math.sin(angle)
    turn = math.radians(yaw)
    local_x = dx * math.cos(turn) + dy * math.sin(turn)
    local_y = -dx * math.sin(turn) + dy * math.cos(turn)
    reach_x = math.inf if abs(local_x) < 1e-9 else width / 2.0 / abs(local_x)
    reach_y = math.inf if abs(local_y) < 1e-9 else height / 2.0 / abs(local_y)
    reach = min(reach_x, reach_y)
    return rounded(center[0] + dx * reach, center[1] + dy * reach)


def polyline_length(points: tuple[Point, ...]) -> float:
    """Length (cm) of a polyline."""
    return sum(length(a, b) for a, b in pairwise(points))


def _distance_sq(a: Point, b: Point) -> float:
    dx, dy = rounded(b[0] - a[0], b[1] - a[1])
    return dx * dx + dy * dy
