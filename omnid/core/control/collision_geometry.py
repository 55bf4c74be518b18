"""A moving base: the way that it drove, and the time until its outline touches a point; exact, in plain Python.

The base moves with (v, w): in its own frame a point at rest turns with -w about the centre (0, v / w).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from calib.se2 import IDENTITY, Point, Pose2, along_arc, composed, relative, seen_from
from omnid.core.control.heading_controller import Twist
from omnid.core.nanoseconds import S_PER_NS

# Slower turns count as none; at 0.5 m/s an arc of 500 m, which errs by 4 mm in 2 m: enough.
STRAIGHT_RADPS: Final = 1e-3
TINY: Final = 1e-9  # Added to divisors, so that no division is by zero.
MOST_MOTIONS: Final = 400  # remembered between a scan's images and now, because 2 s at the highest rate of ticks


class Outline(NamedTuple):
    """Rectangle about the base's origin, parallel to its axes; distances from the origin, m."""

    front_m: float
    rear_m: float
    half_width_m: float

    def grown(self, front_m: float, rear_m: float, side_m: float) -> Outline:
        """Return the outline enlarged by margins in front, behind and on both sides [m]."""
        return Outline(self.front_m + front_m, self.rear_m + rear_m, self.half_width_m + side_m)

    def offset_m(self, x_m: float, y_m: float) -> Point:
        """Return the way from the outline to a point, (0, 0) inside and at the edge."""
        dx = max(x_m - self.front_m, 0.0) - max(-self.rear_m - x_m, 0.0)
        return dx, math.copysign(max(abs(y_m) - self.half_width_m, 0.0), y_m)

    def gap_m(self, x_m: float, y_m: float) -> float:
        """Return the distance of a point from the outline, 0 inside."""
        return math.hypot(*self.offset_m(x_m, y_m))

    @property
    def radius_m(self) -> float:
        """Distance of the farthest corner from the origin."""
        return math.hypot(max(self.front_m, self.rear_m), self.half_width_m)

    def edge_m(self, c: float, s: float) -> float:
        """Return the distance of the edge from the origin in a direction, given by its cosine and sine."""
        along_m = (self.front_m if c > 0 else self.rear_m) / max(abs(c), TINY)
        return min(along_m, self.half_width_m / max(abs(s), TINY))

    def approach_mps(self, x_m: float, y_m: float, motion: Twist) -> float:
        """Return the speed at which a motion takes the outline nearer to a point, or a point inside it deeper."""
        vx, vy = motion.yaw_rate_radps * y_m - motion.velocity_mps, -motion.yaw_rate_radps * x_m
        dx, dy = self.offset_m(x_m, y_m)
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

    def contact_s(self, motion: Twist, points: Iterable[Point]) -> float:
        """Return the time until the outline first touches one of the points outside it, inf if it never does."""
        v, w = motion.velocity_mps, motion.yaw_rate_radps
        if abs(w) < STRAIGHT_RADPS:
            edge_m, side = (self.front_m, 1.0) if v > 0.0 else (self.rear_m, -1.0)
            ways_m = (side * x - edge_m for x, y in points if v and abs(y) <= self.half_width_m)
            return min((way_m for way_m in ways_m if way_m >= 0.0), default=math.inf) / max(abs(v), TINY)
        # 1. The edges lie in a ring about the centre, and so does what they can touch: most points are left out.
        radius_m, longest_m = v / w, max(self.front_m, self.rear_m)
        beside_m = self.half_width_m - abs(radius_m)
        nearest_m = min(self.front_m, self.rear_m, beside_m) if beside_m > 0.0 else -beside_m
        farthest2 = longest_m**2 + (self.half_width_m + abs(radius_m)) ** 2
        # 2. The angle to the first crossing of a point's circle about (0, radius_m) with an edge.
        first_rad = math.inf
        for x_m, y_m in points:
            rho2 = x_m**2 + (y_m - radius_m) ** 2
            if nearest_m**2 <= rho2 <= farthest2:
                start_rad = math.atan2(y_m - radius_m, x_m)
                for x, y in self._crossings(radius_m, rho2):
                    turned_rad = (start_rad - math.atan2(y - radius_m, x)) * math.copysign(1.0, w)
                    first_rad = min(first_rad, turned_rad % math.tau)
        return first_rad / abs(w)

    def _crossings(self, radius_m: float, rho2: float) -> Iterator[Point]:
        """Yield the points where a circle about (0, radius_m) crosses the edges."""
        for x in (self.front_m, -self.rear_m):
            rise = math.sqrt(max(rho2 - x * x, 0.0))
            yield from (
                (x, y) for y in (radius_m + rise, radius_m - rise) if rho2 >= x * x and abs(y) <= self.half_width_m
            )
        for y in (self.half_width_m, -self.half_width_m):
            across2 = rho2 - (y - radius_m) ** 2
            reach = math.sqrt(max(across2, 0.0))
            yield from ((x, y) for x in (reach, -reach) if across2 >= 0.0 and -self.rear_m <= x <= self.front_m)

    def driven_over(self, points: list[Point], pose: Pose2, side: float) -> bool:
        """True if a base that has come to this pose drove over a point that was ahead of its leading edge.

        Such a point is inside the outline or behind it, where a motion straight on does not take it nearer. side: 1.0
        where the front leads, else -1.0.
        """
        edge_m, way_m = self.front_m if side > 0.0 else self.rear_m, math.hypot(pose.x_m, pose.y_m)
        reach2 = (edge_m + self.half_width_m + 2 * way_m) ** 2  # what is farther away was not driven over
        ahead = [(x, y) for x, y in points if side * x >= edge_m - TINY and x * x + y * y <= reach2]
        now = seen_from(pose, ahead)
        return any(edge_m - way_m <= side * x < edge_m and abs(y) <= self.half_width_m for x, y in now)


class DrivenWay:
    """Where the base was at the newest MOST_MOTIONS ticks, from each of which on it followed a motion."""

    def __init__(self) -> None:
        self._ticks: deque[tuple[int, Twist, Pose2]] = deque(maxlen=MOST_MOTIONS)

    def add(self, now_ns: int, motion: Twist) -> None:
        """Take the motion that the base follows from now on."""
        self._ticks.append((now_ns, motion, self._at(now_ns)))

    def reaches_back_to(self, stamp_ns: int) -> bool:
        """True if no motion after a stamp was forgotten."""
        return len(self._ticks) < MOST_MOTIONS or self._ticks[0][0] <= stamp_ns

    def since(self, stamp_ns: int, now_ns: int) -> Pose2:
        """Return the pose of the base now, in its own frame at a stamp."""
        return relative(self._at(min(stamp_ns, now_ns)), self._at(now_ns))

    def _at(self, stamp_ns: int) -> Pose2:
        """Return the pose at a time, where it stood before the first motion."""
        if not self._ticks:
            return IDENTITY
        at_ns, motion, pose = next((tick for tick in reversed(self._ticks) if tick[0] <= stamp_ns), self._ticks[0])
        passed_s = max(stamp_ns - at_ns, 0) * S_PER_NS
        return composed(pose, along_arc(motion.velocity_mps, motion.yaw_rate_radps, passed_s))
