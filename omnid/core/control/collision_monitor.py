"""Collision monitor: the part of a motion that the control law is about to give after which the base can still stop.

Passive safety (Macek, Vasquez, Fraichard, Siegwart 2009, "Towards safe vehicle navigation in dynamic urban scenarios"):
whatever the base would reach, it must be at rest before. What the scan shows are kinds of one thing, points in the way:
obstacles, ends of the floor that was seen, parts of the images that show nothing, and moving obstacles where they will
be. One test judges each kind: the outline with the distance to keep, on the side to which the base is commanded, along
the commanded arc (as the collision monitor of nav2: Macenski et al. 2023); a motion that leads away is free. Plain
Python: it runs in the process that steers.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Annotated, Final, Literal, NamedTuple

from msgspec import Meta

from calib.se2 import IDENTITY, Point, Pose2, along_arc, composed, relative, seen_from
from omnid.core.control.heading_controller import BRAKING_SHARE, Twist
from omnid.core.nanoseconds import S_PER_NS

STOP: Final = "stop"


@dataclass(frozen=True, slots=True)
class CollisionSettings:
    """Outline of the base, distances and times at which it stops and slows down before obstacles."""

    check: Annotated[bool, "slow down and stop before obstacles, whatever the source of the command"] = True
    front_m: Annotated[
        float, Meta(ge=0, le=5), "outline of the base: its front, m ahead of the origin of base_link"
    ] = 0.25
    rear_m: Annotated[float, Meta(ge=0, le=5), "outline of the base: its rear, m behind the origin"] = 0.25
    half_width_m: Annotated[float, Meta(ge=0.01, le=5), "outline of the base: half its width, m"] = 0.22
    stop_m: Annotated[float, Meta(ge=0.01, le=5), "the base stops so far before an obstacle, m"] = 0.15
    side_m: float = 0.04  # free space that it needs at its sides, m
    time_s: float = 1.5  # time to collision that it keeps: speed <= distance / time_s, s
    slow_m: float = 0.5  # an obstacle nearer than this ahead slows it down to slow_mps, m
    slow_side_m: float = 0.12  # the same at the side of its way, m
    slow_mps: Annotated[float, Meta(ge=0.01, le=10), "speed near obstacles and into the unknown, m/s"] = 0.2
    unknown: Annotated[
        Literal["stop", "slow"],
        "at the end of the floor that was seen, where nothing is known: stop; slow drives on at "
        "slow_mps, also into a plain wall",
    ] = STOP
    stale_s: Annotated[
        float,
        Meta(ge=0.1, le=10),
        "no motion without evidence: the base stops where the newest scan of obstacles is older, whatever the pose "
        "says, s",
    ] = 0.5

    @property
    def outline(self) -> Outline:
        """Outline of the base."""
        return Outline(self.front_m, self.rear_m, self.half_width_m)


class MovingPoint(NamedTuple):
    """A moving obstacle in the base frame of its scan, whose axes do not move; m, m/s."""

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    radius_m: float
    sigma_m: float = 0.0  # standard deviation of the place
    sigma_mps: float = 0.0  # standard deviation of the velocity


class ControllerScan(NamedTuple):
    """The part of an obstacle scan that the monitor needs; sector k is about azimuth -pi + (k + 0.5) 2 pi / N."""

    stamp_ns: int  # time of the capture
    ranges_m: tuple[float, ...]  # (N,) inf: free, NaN: unknown
    free_m: tuple[float, ...] = ()  # (N,) up to which a direction was seen to be free; empty: the range, 0 if unknown
    moving: tuple[MovingPoint, ...] = ()
    unobserved: tuple[bool, ...] = ()  # (N,) True: the images show nothing to rely on there; empty: nowhere


# Slower turns count as none; at 0.5 m/s an arc of 500 m, which errs by 4 mm in 2 m: enough.
STRAIGHT_RADPS: Final = 1e-3
TINY: Final = 1e-9  # Added to divisors, so that no division is by zero.


class Outline(NamedTuple):
    """Rectangle about the base's origin, parallel to its axes; distances from the origin, m."""

    front_m: float
    rear_m: float
    half_width_m: float

    def grown(self, front_m: float, rear_m: float, side_m: float) -> Outline:
        """Return the outline enlarged by margins in front, behind and on both sides [m]."""
        return Outline(self.front_m + front_m, self.rear_m + rear_m, self.half_width_m + side_m)

    def depth_m(self, x_m: float, y_m: float) -> float:
        """Return the distance of a point from the outline; inside, that to the nearest edge, negative."""
        dx, dy = max(x_m - self.front_m, -self.rear_m - x_m), abs(y_m) - self.half_width_m
        return max(dx, dy) if max(dx, dy) <= 0.0 else math.hypot(max(dx, 0.0), max(dy, 0.0))

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
        # The velocity of the point in the frame of the base, towards the nearest edges.
        vx, vy = motion.velocity_mps - motion.yaw_rate_radps * y_m, motion.yaw_rate_radps * x_m
        ahead_m, behind_m, dy = x_m - self.front_m, -self.rear_m - x_m, abs(y_m) - self.half_width_m
        dx, vx = (ahead_m, vx) if ahead_m > behind_m else (behind_m, -vx)
        vy = vy if y_m > 0.0 else -vy
        if max(dx, dy) <= 0.0:
            return vx if dx > dy else vy
        dx, dy = max(dx, 0.0), max(dy, 0.0)
        return (dx * vx + dy * vy) / math.hypot(dx, dy)

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


# Floor that is seen so far is open; a scan may end nearer than that, and nothing is known beyond.
FAR_M: Final = 5.0
UNKNOWN_SECTORS: Final = 5  # consecutive ones that make a direction unknown; by trial on development seeds


class UnknownEnd(NamedTuple):
    """End of the floor that was seen in a sector of a scan."""

    sector: int
    free_m: float
    is_gap: bool  # a surface is seen beyond it


def unknown_ends(ranges_m: Sequence[float], free_m: Sequence[float], stop_m: float) -> list[UnknownEnd]:
    """Return the sectors in which nothing is known beyond the floor that was seen.

    ranges_m (N,): of obstacles, inf: free, NaN: unknown; free_m (N,): up to which floor was seen, empty: the range, 0
    where that is unknown. stop_m: length without floor before a surface that belongs to the surface.
    """
    free = free_m if len(free_m) == len(ranges_m) else [r if math.isfinite(r) else 0.0 for r in ranges_m]
    # A surface that is seen past a place that is not, such as a wall behind a plain pole, makes that no freer.
    has_gap = [math.isfinite(r) and r - f > stop_m for r, f in zip(ranges_m, free, strict=True)]
    parts = zip(ranges_m, free, has_gap, strict=True)
    unknown = [gap or math.isnan(r) or (math.isinf(r) and 0.0 < f < FAR_M) for r, f, gap in parts]
    # Runs go around the full turn.
    start = unknown.index(False) if False in unknown else 0
    runs = groupby((*range(start, len(unknown)), *range(start)), unknown.__getitem__)
    long = (run for is_unknown, of in runs if is_unknown and len(run := list(of)) >= UNKNOWN_SECTORS)
    return [UnknownEnd(k, free[k], has_gap[k]) for run in long for k in run]


LEAST_MPS: Final = 0.02  # slower than this the base stops; by trial on development seeds
# A way that approaches an unknown region at its side by no more than this slope runs along it, because a correction of
# the heading by three degrees does. The nearest corner is then 5 cm nearer after 1 m, before which newer scans judge.
ALONG_SLOPE: Final = 0.05
# Free ranges change by a cell of so much from scan to scan; corrections of the heading swing no corner farther.
BESIDE_M: Final = 0.05
# Step of the prediction of moving obstacles, short because a person at 1.5 m/s moves 0.15 m in it.
MOVING_STEP_S: Final = 0.1
MOVING_S: Final = 2.0  # the base slows down where it would meet a moving obstacle sooner: a person walks 3 m in it
NEW_MPS: Final = 0.4  # Sigma of a velocity by two pairs, large because a third one makes it smaller.
# Speed of a person who walks towards the base, and the time until it brakes, because two pairs at 10 Hz show the
# person, and images and commands are 0.2 s on their way.
WALK_MPS, TURN_S = 1.6, 0.4

BLOCKED: Final = "an obstacle is in the way"
NEAR: Final = "an obstacle is near"
MOVING: Final = "a moving obstacle comes into the way"
UNKNOWN: Final = "the way ahead is unknown"
UNOBSERVED: Final = "the images of the way ahead are frozen, dark or dirty"
UNSEEN: Final = "the images show nothing: they are frozen, dark or dirty"
SCAN_STALE: Final = "no new obstacle scan"
IMAGES_REMEDY: Final = "check light, mirrors, cameras and load, which the status names"


def remedy(reason: str) -> str:
    """Return what to do about a reason to slow down or stop."""
    return IMAGES_REMEDY if reason in (SCAN_STALE, UNOBSERVED, UNSEEN) else "drive back or turn away, or clear the way"


class Allowance(NamedTuple):
    """Allowed share of a motion, and why it is less than all of it."""

    share: float = 1.0
    reason: str = ""  # empty where the share is 1


FREE: Final = Allowance()


class Kind(NamedTuple):
    """Places of a scan that the base must not reach, in the frame of the scan."""

    reason: str
    policy: str  # "stop" or "slow"
    points: list[Point]
    is_known: bool = False  # something is there; else nothing is known of what is there
    is_gap: bool = False  # a surface is seen beyond: it counts ahead of the base only


class CollisionMonitor:
    """Follows scans and commands; not thread-safe. Memory and work of a tick are bounded by the scan's size."""

    def __init__(self, settings: CollisionSettings, braking_mps2: float, turn_braking_radps2: float = math.inf) -> None:
        """braking_mps2, turn_braking_radps2: with which the base can brake its speed and its turn."""
        self._settings = settings
        self._deceleration, self._turn_deceleration = BRAKING_SHARE * braking_mps2, BRAKING_SHARE * turn_braking_radps2
        self._outline = settings.outline
        # Room for turns where the images show nothing.
        self._around = self._outline.grown(settings.stop_m, settings.stop_m, settings.side_m + BESIDE_M)
        self._stamp_ns: int | None = None
        self._kinds: tuple[Kind, ...] = ()  # what the newest scan shows
        self._is_blind = False  # its images show nothing at all
        self._moving: tuple[MovingPoint, ...] = ()
        # Time, pose, and the motion that the base followed from then on, of the newest ticks.
        self._ticks: deque[tuple[int, Twist, Pose2]] = deque()
        self.reason = ""  # why the last step changed the motion
        self.holds = False  # the motion was stopped, or could only creep
        self.share = 1.0  # share of the motion that was allowed; 0 also where only a turn on the spot was
        self._stopped_mps = 0.0  # motion that the last step stopped

    def set_scan(self, scan: ControllerScan) -> None:
        """Replace the scan, unless it is older."""
        if (self._stamp_ns is not None and scan.stamp_ns < self._stamp_ns) or not scan.ranges_m:
            return
        self._stamp_ns, self._moving = scan.stamp_ns, scan.moving
        settings, count = self._settings, len(scan.ranges_m)
        unobserved = scan.unobserved if len(scan.unobserved) == count else (False,) * count
        self._is_blind = all(unobserved)
        azimuths = ((k + 0.5) * (math.tau / count) - math.pi for k in range(count))
        directions = [(math.cos(azimuth), math.sin(azimuth)) for azimuth in azimuths]
        seen = [(r * c, r * s) for r, (c, s) in zip(scan.ranges_m, directions, strict=True) if math.isfinite(r)]
        ends: dict[str, list[Point]] = {"unobserved": [], "gap": [], "end": []}
        for k, free_m, is_gap in unknown_ends(scan.ranges_m, scan.free_m, settings.stop_m):
            c, s = directions[k]
            begins_m = self._around.edge_m(c, s) if unobserved[k] else max(free_m, self._outline.edge_m(c, s))
            ends["unobserved" if unobserved[k] else "gap" if is_gap else "end"].append((begins_m * c, begins_m * s))
        self._kinds = (
            Kind(BLOCKED, STOP, seen, is_known=True),
            Kind(UNKNOWN, settings.unknown, ends["end"]),
            Kind(UNKNOWN, settings.unknown, ends["gap"], is_gap=True),
            Kind(UNOBSERVED, STOP, ends["unobserved"]),
        )

    def step(self, now_ns: int, motion: Twist, *, to_heading: bool = False) -> Twist:
        """Return the part of a motion that is allowed now; speed and yaw rate are reduced together, as on one arc.

        to_heading: the yaw rate leads to a heading, to which the base turns on the spot where it may not drive.
        Otherwise it would never move again where the arc to a free direction is closed.
        """
        # 1. Judge the motion; a base that was stopped stays so while it could only creep on by two cells.
        share, reason = self._judged(now_ns, motion)
        speed_mps = abs(motion.velocity_mps)
        creeps = share < 1.0 and share * speed_mps < min(2 * BESIDE_M / self._settings.time_s, speed_mps / 2)
        if creeps and self._stopped_mps * motion.velocity_mps > 0.0 and share > 0.0:
            share, reason = 0.0, self.reason
        self.share, self.reason = share, reason
        self._stopped_mps = motion.velocity_mps if share == 0.0 else 0.0
        edge_mps = max(speed_mps, abs(motion.yaw_rate_radps) * self._outline.radius_m)
        self.holds = share * edge_mps < min(LEAST_MPS, edge_mps)
        # 2. Where it may not drive, it may turn.
        if share == 0.0 and to_heading:
            motion = Twist(0.0, motion.yaw_rate_radps)
            share = self._judged(now_ns, motion).share
        # 3. Scale both speeds by the same share.
        return motion if share >= 1.0 else Twist(share * motion.velocity_mps, share * motion.yaw_rate_radps)

    def follow(self, now_ns: int, motion: Twist) -> None:
        """Take the motion that the base follows from now on."""
        self._ticks.append((now_ns, motion, self._pose_at(now_ns)))
        while len(self._ticks) > 1 and self._ticks[1][0] < now_ns - self._settings.stale_s / S_PER_NS:
            self._ticks.popleft()

    def _pose_at(self, stamp_ns: int) -> Pose2:
        """Return the pose of the base at a time; before the first motion it stood."""
        if not self._ticks:
            return IDENTITY
        at_ns, motion, pose = next((tick for tick in reversed(self._ticks) if tick[0] <= stamp_ns), self._ticks[0])
        passed_s = max(stamp_ns - at_ns, 0) * S_PER_NS
        return composed(pose, along_arc(motion.velocity_mps, motion.yaw_rate_radps, passed_s))

    def _judged(self, now_ns: int, motion: Twist) -> Allowance:
        """Return the strictest allowance of all kinds of what is known."""
        settings, is_driving = self._settings, motion.velocity_mps != 0.0
        if not settings.check or not (is_driving or motion.yaw_rate_radps):
            return FREE
        # 1. Without a recent scan nothing is known.
        age_s = math.inf if self._stamp_ns is None else (now_ns - self._stamp_ns) * S_PER_NS
        if not abs(age_s) <= settings.stale_s:
            return Allowance(0.0, SCAN_STALE)
        if self._is_blind:
            return Allowance(0.0, UNSEEN)
        # 2. What the base has driven over since the scan's images is not passed as if it were free.
        moved = relative(self._pose_at(min(self._stamp_ns or now_ns, now_ns)), self._pose_at(now_ns))
        for kind in self._kinds:
            over = is_driving and kind.policy == STOP
            if over and self._outline.driven_over(kind.points, moved, math.copysign(1.0, motion.velocity_mps)):
                return Allowance(0.0, kind.reason)
        # 3. The way before each kind, and before what moves; what is out of reach is left out.
        speed_mps = abs(motion.velocity_mps)
        way_m = max(speed_mps * settings.time_s, speed_mps**2 / (2 * self._deceleration))
        near_m = max(settings.stop_m + settings.slow_m, settings.side_m, settings.slow_side_m)
        reach2 = (way_m + near_m + self._outline.radius_m) ** 2
        allowances = [FREE]
        for kind in self._kinds:
            if kind.points:
                near = [(x, y) for x, y in kind.points if (x - moved.x_m) ** 2 + (y - moved.y_m) ** 2 <= reach2]
                allowances.append(self._before(kind, seen_from(moved, near), motion))
        allowances += [self._before_moving(one, moved, age_s, motion) for one in self._moving]
        return min(allowances)

    def _before(self, kind: Kind, points: list[Point], motion: Twist) -> Allowance:
        """Return the allowance before points of a kind, in the axes of the base now."""
        settings, outline, speed_mps = self._settings, self._outline, abs(motion.velocity_mps)
        side = math.copysign(1.0, motion.velocity_mps)
        edge_m = outline.front_m if side > 0.0 else outline.rear_m
        # 1. What is there: its distance, and a low speed near it.
        if kind.is_known:
            share = self._share_before(points, motion)
            allowance = FREE if share >= 1.0 else Allowance(share, BLOCKED if share == 0.0 else NEAR)
            wide_m = outline.half_width_m + settings.slow_side_m
            if speed_mps > settings.slow_mps and any(
                0.0 <= side * x <= edge_m + settings.slow_m and abs(y) <= wide_m for x, y in points
            ):
                allowance = min(allowance, self._capped(motion, settings.slow_mps, NEAR))
            return allowance
        # 2. Where nothing is known, a way along it is free, and one into it is driven slowly, or not at all. Gaps count
        #    ahead only: next to or behind the base a person would hide the surface that ends a gap, and the front of
        #    the base has already passed where a thin object could be.
        if speed_mps > 0.0:
            if kind.is_gap:
                points = [(x, y) for x, y in points if side * x > edge_m]
        elif kind.reason == UNOBSERVED:
            return FREE
        else:
            # Corners may swing as far as floor was seen. An unknown region at the outline itself does not count: it
            # would keep the base from turning away.
            stop = self._stop_polygon(motion)
            points = [point for point in points if stop.depth_m(*point) > 0.0]
            speed_mps = abs(motion.yaw_rate_radps) * outline.radius_m
        least = 0.0 if kind.policy == STOP else min(1.0, settings.slow_mps / speed_mps)
        share = max(self._share_before(points, motion, ALONG_SLOPE), least)
        return FREE if share >= 1.0 else Allowance(share, kind.reason)

    def _share_before(self, points: list[Point], motion: Twist, slope: float = 0.0) -> float:
        """Return the share of a motion that keeps the time to a collision, and from which the base still stops.

        slope: points at the distance to keep already count where the way to them is steeper.
        """
        speed_mps = abs(motion.velocity_mps)
        stop, outside, least_mps = self._stop_polygon(motion), [], max(slope * speed_mps, TINY)
        for point in points:
            if stop.depth_m(*point) > 0.0:
                outside.append(point)
            elif self._outline.approach_mps(*point, motion) > least_mps:
                return 0.0
        first_s = stop.contact_s(motion, outside)
        if first_s == math.inf:
            return 1.0
        turn_radps = max(abs(motion.yaw_rate_radps), TINY)
        share = min(first_s / self._settings.time_s, math.sqrt(2 * self._turn_deceleration * first_s / turn_radps))
        if speed_mps > 0.0:
            share = min(share, math.sqrt(2 * self._deceleration * speed_mps * first_s) / speed_mps)
            if share < 1.0 and share * speed_mps < LEAST_MPS:
                return 0.0
        return min(1.0, share)

    def _stop_polygon(self, motion: Twist) -> Outline:
        """Return the outline with the distance to keep on the side to which the base moves, and at its sides."""
        stop_m, v = self._settings.stop_m, motion.velocity_mps
        return self._outline.grown(stop_m * (v > 0.0), stop_m * (v < 0.0), self._settings.side_m)

    def _before_moving(self, one: MovingPoint, moved: Pose2, age_s: float, motion: Twist) -> Allowance:
        """Slow down by the time until a moving obstacle, at its predicted place, is where the base would then be.

        A new one may be anywhere within one sigma: two pairs show roughly where it goes. And a person who is passed may
        turn round: the base is at rest before that person, or a hidden one, reaches it across a gap g, with
        `g = WALK_MPS (TURN_S + v / a)`; who leaves lets it drive on slowly. Persons behind the base do not count.
        """
        settings, stop, speed_mps = self._settings, self._stop_polygon(motion), abs(motion.velocity_mps)
        side = math.copysign(1.0, motion.velocity_mps)
        allowance = FREE
        for step in range(round(MOVING_S / MOVING_STEP_S)):
            ahead_s = step * MOVING_STEP_S
            at_s = age_s + ahead_s
            place = (one.x_m + one.vx_mps * at_s, one.y_m + one.vy_mps * at_s)
            pose = composed(moved, along_arc(motion.velocity_mps, motion.yaw_rate_radps, ahead_s))
            [(x, y)] = seen_from(pose, [place])
            if step == 0:
                gap_m = max(self._outline.depth_m(x, y), 0.0) - one.radius_m
                limit_mps = self._deceleration * (gap_m / WALK_MPS - TURN_S)
                if speed_mps > max(limit_mps, 0.0) and side * x > -self._outline.rear_m:
                    dx, dy = place[0] - moved.x_m, place[1] - moved.y_m
                    leaves_mps = (dx * one.vx_mps + dy * one.vy_mps) / max(math.hypot(dx, dy), TINY)
                    least_mps = settings.slow_mps if leaves_mps > one.sigma_mps else 0.0
                    allowance = self._capped(motion, max(least_mps, limit_mps), MOVING)
                if self._outline.approach_mps(x, y, motion) <= TINY:
                    continue
            gap_m = max(stop.depth_m(x, y), 0.0) - one.radius_m
            if gap_m <= 0.0:
                # No newer scan need come within stale_s.
                share = 0.0 if ahead_s <= settings.stale_s else ahead_s / MOVING_S
                return min(allowance, Allowance(share, MOVING))
            if one.sigma_mps > NEW_MPS and gap_m <= math.hypot(one.sigma_m, at_s * one.sigma_mps):
                most_mps = max(settings.slow_mps, speed_mps * ahead_s / MOVING_S)
                allowance = min(allowance, self._capped(motion, most_mps, MOVING))
        return allowance

    def _capped(self, motion: Twist, speed_mps: float, reason: str) -> Allowance:
        """Return the share at which the speed is at most so high; turns on the spot slow down by the same share."""
        if speed_mps <= 0.0:
            return Allowance(0.0, reason)
        edge_mps = max(abs(motion.velocity_mps), abs(motion.yaw_rate_radps) * self._outline.radius_m)
        return FREE if edge_mps <= speed_mps else Allowance(speed_mps / edge_mps, reason)
