"""A moving base: the way that it drove, and the time until its outline touches a point; exact, in plain Python.

The base moves with (v, w): in its own frame a point at rest turns with -w about the centre (0, v / w).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import groupby
from typing import Final, NamedTuple

from calib.se2 import IDENTITY, Point, Pose2, along_arc, composed, seen_from
from omnid.core.control.heading_controller import Twist
from omnid.core.nanoseconds import S_PER_NS

# Slower turns count as none; at 0.5 m/s an arc of 500 m, which errs by 4 mm in 2 m: enough.
STRAIGHT_RADPS: Final = 1e-3
TINY: Final = 1e-9  # Added to divisors, so that no division is by zero.
MOST_MOTIONS: Final = 400  # remembered between a ring's images and now, because 2 s at the highest rate of ticks


class Outline(NamedTuple):
    """Rectangle about the base's origin, parallel to its axes; distances from the origin, m."""

    front_m: float
    rear_m: float
    half_width_m: float

    def parted(self, points: Iterable[Point]) -> tuple[list[Point], list[Point]]:
        """Return the points inside, also those at the edge, and the others."""
        behind_m, front_m, half_width_m = -self.rear_m, self.front_m, self.half_width_m
        inside: list[Point] = []
        outside: list[Point] = []
        for point in points:
            is_inside = behind_m <= point[0] <= front_m and abs(point[1]) <= half_width_m
            (inside if is_inside else outside).append(point)
        return inside, outside

    def gap_m(self, x_m: float, y_m: float) -> float:
        """Return the distance of a point from the outline, 0 inside."""
        return math.hypot(max(x_m - self.front_m, -self.rear_m - x_m, 0.0), max(abs(y_m) - self.half_width_m, 0.0))

    @property
    def radius_m(self) -> float:
        """Distance of the farthest corner from the origin."""
        return math.hypot(max(self.front_m, self.rear_m), self.half_width_m)

    def edge_m(self, azimuth_rad: float) -> float:
        """Return the distance of the edge from the origin in a direction."""
        c, s = math.cos(azimuth_rad), abs(math.sin(azimuth_rad))
        along_m = (self.front_m if c > 0 else self.rear_m) / max(abs(c), TINY)
        return min(along_m, self.half_width_m / max(s, TINY))

    def approach_mps(self, x_m: float, y_m: float, motion: Twist) -> float:
        """Return the speed at which a motion takes the outline nearer to a point, or a point inside it deeper."""
        vx, vy = motion.yaw_rate_radps * y_m - motion.velocity_mps, -motion.yaw_rate_radps * x_m
        dx = max(x_m - self.front_m, 0.0) - max(-self.rear_m - x_m, 0.0)
        dy = math.copysign(max(abs(y_m) - self.half_width_m, 0.0), y_m)
        if dx == 0.0 and dy == 0.0:  # inside: the way out is over the nearest edge
            edges = (
                (self.front_m - x_m, 1.0, 0.0),
                (self.rear_m + x_m, -1.0, 0.0),
                (self.half_width_m - y_m, 0.0, 1.0),
                (self.half_width_m + y_m, 0.0, -1.0),
            )
            _, dx, dy = min(edges)
        # A speed, not its product with the distance: a point at the edge is approached as any other.
        return -(dx * vx + dy * vy) / math.hypot(dx, dy)


def contact_s(outline: Outline, motion: Twist, points: Iterable[Point]) -> float:
    """Return the time until the outline first touches one of the points outside it, inf if it never does."""
    v, w = motion.velocity_mps, motion.yaw_rate_radps
    if abs(w) >= STRAIGHT_RADPS:
        return _on_arc_s(outline, v / w, w, points)
    if v == 0.0:
        return math.inf
    edge_m, side = (outline.front_m, 1.0) if v > 0.0 else (outline.rear_m, -1.0)
    ways_m = (side * x - edge_m for x, y in points if abs(y) <= outline.half_width_m)
    return min((way_m for way_m in ways_m if way_m >= 0.0), default=math.inf) / abs(v)


def _on_arc_s(outline: Outline, radius_m: float, w: float, points: Iterable[Point]) -> float:
    """Return the time until the first crossing of a point's circle about (0, radius_m) with an edge."""
    # 1. The edges lie in a ring about the centre, and so does what they can touch: most points are left out by that.
    front_m, rear_m, half_width_m = outline
    beside_m = half_width_m - abs(radius_m)
    nearest_m = min(front_m, rear_m, beside_m) if beside_m > 0.0 else -beside_m
    farthest2 = max(front_m, rear_m) ** 2 + (half_width_m + abs(radius_m)) ** 2
    # 2. The angle to the first crossing of each of the others.
    first = math.inf
    for x_m, y_m in points:
        rho2 = x_m**2 + (y_m - radius_m) ** 2
        if nearest_m**2 <= rho2 <= farthest2:
            start = math.atan2(y_m - radius_m, x_m)
            for x, y in _crossings(outline, radius_m, rho2):
                turned = (start - math.atan2(y - radius_m, x)) * math.copysign(1.0, w)
                first = min(first, turned % math.tau)
    return first / abs(w)


def _crossings(outline: Outline, radius_m: float, rho2: float) -> list[tuple[float, float]]:
    """Return the points where a circle about (0, radius_m) crosses the edges."""
    found = []
    for x in (outline.front_m, -outline.rear_m):
        if rho2 >= x * x:
            rise = math.sqrt(rho2 - x * x)
            found += [(x, y) for y in (radius_m + rise, radius_m - rise) if abs(y) <= outline.half_width_m]
    for y in (outline.half_width_m, -outline.half_width_m):
        across2 = rho2 - (y - radius_m) ** 2
        if across2 >= 0.0:
            reach = math.sqrt(across2)
            found += [(x, y) for x in (reach, -reach) if -outline.rear_m <= x <= outline.front_m]
    return found


def within_reach(points: list[Point], pose: Pose2, reach_m: float) -> list[Point]:
    """Return the points within reach of a pose, in its axes."""
    (px, py), reach2 = pose[:2], reach_m * reach_m
    return seen_from(pose, [(x, y) for x, y in points if (x - px) * (x - px) + (y - py) * (y - py) <= reach2])


def driven_over(outline: Outline, points: list[Point], pose: Pose2, velocity_mps: float) -> bool:
    """True if a base that has come to this pose drove over a point that was ahead of its leading edge.

    Such a point is inside the outline or behind it, where a motion straight on does not take it nearer.
    """
    side = math.copysign(1.0, velocity_mps)
    edge_m = outline.front_m if side > 0.0 else outline.rear_m
    way_m = math.hypot(pose.x_m, pose.y_m)
    reach2 = (edge_m + outline.half_width_m + 2 * way_m) ** 2  # what is farther away was not driven over
    ahead = [(x, y) for x, y in points if side * x >= edge_m - TINY and x * x + y * y <= reach2]
    return any(
        edge_m - way_m <= side * x < edge_m and abs(y) <= outline.half_width_m for x, y in seen_from(pose, ahead)
    )


def long_runs(flags: Sequence[bool], least: int) -> list[int]:
    """Return the indices of the true flags in runs of at least so many, around the full turn."""
    start = flags.index(False) if False in flags else 0
    order = (*range(start, len(flags)), *range(start))
    runs = [list(run) for is_true, run in groupby(order, flags.__getitem__) if is_true]
    return [k for run in runs if len(run) >= least for k in run]


@lru_cache(maxsize=4)
def sector_edges_m(outline: Outline, count: int) -> tuple[float, ...]:
    """Return the distance of the edge from the origin in the middle of each sector of a ring."""
    return tuple(outline.edge_m(azimuth) for azimuth, _, _ in sector_directions(count))


@lru_cache(maxsize=2)
def sector_directions(count: int) -> tuple[tuple[float, float, float], ...]:
    """Return the azimuth of the middle of each sector of a ring, its cosine and its sine."""
    azimuths = ((k + 0.5) * (math.tau / count) - math.pi for k in range(count))
    return tuple((azimuth, math.cos(azimuth), math.sin(azimuth)) for azimuth in azimuths)


class DrivenMotions:
    """The newest MOST_MOTIONS motions, each from its stamp until that of the next one."""

    def __init__(self) -> None:
        self._motions: deque[tuple[int, Twist]] = deque(maxlen=MOST_MOTIONS)

    def add(self, now_ns: int, motion: Twist) -> None:
        """Take the motion that the base follows from now on."""
        self._motions.append((now_ns, motion))

    def reach_back_to(self, stamp_ns: int) -> bool:
        """True if no motion after a stamp was forgotten."""
        return len(self._motions) < MOST_MOTIONS or self._motions[0][0] <= stamp_ns

    def since(self, stamp_ns: int, now_ns: int) -> Pose2:
        """Return the pose of the base now, in its own frame at a stamp."""
        # 1. The motions since the stamp and their durations, newest first.
        pieces, until_ns = [], now_ns
        for at_ns, motion in reversed(self._motions):
            begin_ns = max(at_ns, stamp_ns)
            if until_ns > begin_ns:
                pieces.append((motion, (until_ns - begin_ns) * S_PER_NS))
            until_ns = min(until_ns, begin_ns)
            if at_ns <= stamp_ns:
                break
        # 2. The poses along them, oldest first.
        pose = IDENTITY
        for motion, dt_s in reversed(pieces):
            pose = composed(pose, along_arc(motion.velocity_mps, motion.yaw_rate_radps, dt_s))
        return pose
