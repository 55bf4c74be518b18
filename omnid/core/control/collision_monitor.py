"""Collision monitor: slows down and stops the motion that the control law is about to give, before obstacles.

The model is the collision monitor of nav2 (Macenski et al. 2023, "From the desks of ROS maintainers", 5): a polygon in
which nothing may be (stop), one in which the base drives slowly, and the time to collision on the commanded arc. Here
the polygons lie on the side to which the base is commanded: a motion that leads away from an obstacle is free.
Unknown directions are not free. Plain Python: it runs in the process that steers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Final, Literal, NamedTuple

from msgspec import Meta

from calib.se2 import Point, Pose2, along_arc, composed, seen_from
from omnid.core.control.collision_geometry import (
    TINY,
    DrivenMotions,
    Outline,
    contact_s,
    driven_over,
    long_runs,
    sector_directions,
    sector_edges_m,
    within_reach,
)
from omnid.core.control.heading_controller import BRAKING_SHARE, Twist
from omnid.core.nanoseconds import S_PER_NS

STOP: Final = "stop"
SLOW: Final = "slow"
IGNORE: Final = "ignore"


@dataclass(frozen=True, slots=True)
class CollisionSettings:
    """Outline of the base, distances and times at which it stops and slows down before obstacles."""

    REMOVED = MappingProxyType(
        {"side_m": "it needs 4 cm of free space at its sides", "time_s": "it keeps 1.5 s to a collision"}
    )

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
    slow_side_m: float = 0.12  # the same beside its way, m
    slow_mps: Annotated[float, Meta(ge=0.01, le=10), "speed near obstacles and into the unknown, m/s"] = 0.2
    unknown: Annotated[
        Literal["stop", "slow", "ignore"],
        "at the end of the floor that was seen, where nothing is known: stop; slow drives on at "
        "slow_mps, also into a plain wall",
    ] = STOP
    stale: Annotated[
        Literal["stop", "slow", "ignore"],
        "when nothing fresh is known of the way: the newest ring of obstacles is older than "
        "stale_s, there is none, or its images are frozen, dark or dirty there",
    ] = STOP
    stale_s: Annotated[
        float,
        Meta(ge=0.1, le=10),
        "no motion without evidence: the base drives by what its images of so long ago, or "
        "newer ones, showed, whatever the pose says, s",
    ] = 0.5


class MovingPoint(NamedTuple):
    """A moving obstacle in the base frame of its ring, whose axes do not move; m, m/s."""

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    radius_m: float
    sigma_m: float = 0.0  # standard deviation of the place
    sigma_mps: float = 0.0  # standard deviation of the velocity


class ControllerRing(NamedTuple):
    """The part of an obstacle ring that the monitor needs; sector k is about azimuth -pi + (k + 0.5) 2 pi / N."""

    stamp_ns: int  # time of the capture
    ranges_m: tuple[float, ...]  # (N,) inf: free, NaN: unknown
    free_m: tuple[float, ...] = ()  # (N,) up to which a direction was seen to be free; empty: the range, 0 if unknown
    moving: tuple[MovingPoint, ...] = ()
    unwatched: tuple[bool, ...] = ()  # (N,) the images show nothing to rely on there; empty: they do everywhere


# Floor that is seen so far is open; a ring may end nearer than that, and nothing is known beyond.
FAR_M: Final = 5.0
UNKNOWN_SECTORS: Final = 5  # consecutive ones that make a direction unknown; by trial on development seeds


class UnknownEnd(NamedTuple):
    """End of the floor that was seen in a sector of a ring."""

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
    return [UnknownEnd(k, free[k], has_gap[k]) for k in long_runs(unknown, UNKNOWN_SECTORS)]


LEAST_MPS: Final = 0.02  # slower than this the base stops; by trial on development seeds
# A way that approaches an unknown region at its side by no more than this slope runs along it, because a correction of
# the heading by three degrees does. The nearest corner is then 5 cm nearer after 1 m, before which newer rings judge.
ALONG_SLOPE: Final = 0.05
# A base that was stopped resumes in that direction only faster than this (half as fast as a slower command), because
# free ranges change by a cell of 5 cm from ring to ring: at time_s of 1.5 s it is the speed for 9 cm.
RESUME_MPS: Final = 0.06
BESIDE_M: Final = 0.05  # Room beyond the sides' clearance, because corrections of the heading swing no corner farther.
# Step of the prediction of moving obstacles, short because a person at 1.5 m/s moves 0.15 m in it.
MOVING_STEP_S: Final = 0.1
MOVING_S: Final = 2.0  # the base slows down where it would meet a moving obstacle sooner: a person walks 3 m in it
NEW_MPS: Final = 0.4  # Sigma of a velocity by two pairs, large because a third one makes it smaller.
MOVING_STOP_S: Final = 0.5  # nearer in time than this, the base stops at once; by trial on development seeds
# Speed of a person who walks towards the base, and the time until it brakes, because two pairs at 10 Hz show the
# person, and images and commands are 0.2 s on their way.
WALK_MPS, TURN_S = 1.6, 0.4
MOST_MOVING: Final = 16  # Most moving obstacles, so that the time of a tick is bounded.

BLOCKED: Final = "an obstacle is in the way"
NEAR: Final = "an obstacle is near"
MOVING: Final = "a moving obstacle comes into the way"
UNKNOWN: Final = "the way ahead is unknown"
UNWATCHED: Final = "the images of the way ahead are frozen, dark or dirty"
UNSEEN: Final = "the images show nothing: they are frozen, dark or dirty"
RING_STALE: Final = "no new obstacle ring"
REMEDY: Final = "drive back or turn away, or clear the way"
RING_REMEDY: Final = "check the cameras and the load; see controller.collision.stale"
IMAGES_REMEDY: Final = "check light, mirrors and cameras, which the status names"


class Allowance(NamedTuple):
    """Allowed share of a motion, and why it is less than all of it."""

    share: float
    reason: str  # empty where the share is 1


FREE: Final = Allowance(1.0, "")


def remedy(reason: str) -> str:
    """Return what to do about a reason to slow down or stop."""
    return {RING_STALE: RING_REMEDY, UNWATCHED: IMAGES_REMEDY, UNSEEN: IMAGES_REMEDY}.get(reason, REMEDY)


class CollisionMonitor:
    """Follows rings and commands; not thread-safe. Memory and work of a tick are bounded by the ring's size."""

    def __init__(self, settings: CollisionSettings, braking_mps2: float, turn_braking_radps2: float = math.inf) -> None:
        """braking_mps2, turn_braking_radps2: with which the base can brake its speed and its turn."""
        self._settings, self._deceleration, self._turn_deceleration = settings, braking_mps2, turn_braking_radps2
        self._outline = Outline(settings.front_m, settings.rear_m, settings.half_width_m)
        side_m = settings.half_width_m + settings.side_m + BESIDE_M  # room for turns where the images show nothing
        self._around = Outline(settings.front_m + settings.stop_m, settings.rear_m + settings.stop_m, side_m)
        self._stamp_ns: int | None = None
        self._points: list[Point] = []  # obstacles in the frame of the ring
        self._unknown: list[Point] = []  # ends of the way that was seen to be free: nothing is known beyond
        self._gaps: list[Point] = []  # the same where a surface is seen beyond
        self._unwatched: list[Point] = []  # around the outline, where the images show nothing
        self._is_blind = False  # they show nothing at all
        self._moving: tuple[MovingPoint, ...] = ()
        self._motions = DrivenMotions()
        self.reason = ""  # why the last step changed the motion
        self.share = 1.0  # share of the motion that was allowed; 0 also where only a turn on the spot was
        self._stopped_mps = 0.0  # motion that the last step stopped

    def set_ring(self, ring: ControllerRing) -> None:
        """Replace the ring, unless it is older."""
        if (self._stamp_ns is not None and ring.stamp_ns < self._stamp_ns) or not ring.ranges_m:
            return
        self._stamp_ns, self._moving = ring.stamp_ns, ring.moving[:MOST_MOVING]
        count, directions = len(ring.ranges_m), sector_directions(len(ring.ranges_m))
        self._points = [
            (r * c, r * s) for r, (_, c, s) in zip(ring.ranges_m, directions, strict=True) if math.isfinite(r)
        ]
        self._unknown, self._gaps, self._unwatched = [], [], []
        unwatched = ring.unwatched if len(ring.unwatched) == count else (False,) * count
        self._is_blind = all(unwatched)
        edges_m, around_m = sector_edges_m(self._outline, count), sector_edges_m(self._around, count)
        for k, free_m, is_gap in unknown_ends(ring.ranges_m, ring.free_m, self._settings.stop_m):
            begins_m = around_m[k] if unwatched[k] else max(free_m, edges_m[k])
            ends = self._unwatched if unwatched[k] else self._gaps if is_gap else self._unknown
            ends.append((begins_m * directions[k][1], begins_m * directions[k][2]))

    def step(self, now_ns: int, motion: Twist, *, to_heading: bool = False) -> Twist:
        """Return the part of a motion that is allowed now; speed and yaw rate are reduced together, as on one arc.

        to_heading: the yaw rate leads to a heading, to which the base turns on the spot where it may not drive.
        Otherwise it would never move again where the arc to a free direction is closed.
        """
        # 1. Judge the motion by the obstacles; a base that was stopped stays so while it could only creep on.
        allowance = self._held(self._judged(now_ns, motion), motion)
        self.share, self.reason = allowance
        self._stopped_mps = motion.velocity_mps if allowance.share == 0.0 else 0.0
        # 2. Where it may not drive, it may turn.
        share = allowance.share
        if share == 0.0 and to_heading:
            motion = Twist(0.0, motion.yaw_rate_radps)
            share = self._judged(now_ns, motion).share
        # 3. Scale both speeds alike.
        return motion if share >= 1.0 else Twist(share * motion.velocity_mps, share * motion.yaw_rate_radps)

    def _held(self, allowance: Allowance, motion: Twist) -> Allowance:
        """Return the allowance, none as long as a base that was stopped could only creep on."""
        speed_mps = abs(motion.velocity_mps)
        if not 0.0 < allowance.share < 1.0 or self._stopped_mps * motion.velocity_mps <= 0.0:
            return allowance
        creeps = allowance.share * speed_mps < min(RESUME_MPS, speed_mps / 2)
        return Allowance(0.0, self.reason) if creeps else allowance

    def follow(self, now_ns: int, motion: Twist) -> None:
        """Take the motion that the base follows from now on."""
        self._motions.add(now_ns, motion)

    def _judged(self, now_ns: int, motion: Twist) -> Allowance:
        """Return the strictest allowance of all rules."""
        settings = self._settings
        if not settings.check or (motion.velocity_mps == 0.0 and motion.yaw_rate_radps == 0.0):
            return FREE
        # 1. Without a recent ring nothing is known.
        age_s = math.inf if self._stamp_ns is None else (now_ns - self._stamp_ns) * S_PER_NS
        without_ring = self._without_ring(age_s, motion)
        if without_ring is not None:
            return without_ring
        # 2. What the base has driven over since the ring's images is not passed as if it were free.
        moved, is_driving = self._motions.since(self._stamp_ns or now_ns, now_ns), motion.velocity_mps != 0.0
        reason = self._driven_over(moved, motion.velocity_mps) if is_driving else ""
        if reason:
            return Allowance(0.0, reason)
        # 3. Each rule by itself: obstacles, unknown and unwatched directions, moving obstacles.
        reach_m = self._reach_m(abs(motion.velocity_mps))
        points = within_reach(self._points, moved, reach_m)
        allowances = [self._before(points, motion), self._near(points, motion)]
        if settings.unknown != IGNORE:
            # Gaps count ahead only: next to or behind the base a person would hide the surface that ends a gap, and
            # the front of the base has already passed where a thin object could be.
            gaps = self._ahead(within_reach(self._gaps, moved, reach_m), motion)
            ends = within_reach(self._unknown, moved, reach_m) + gaps
            allowances.append(self._into_unknown(ends, motion, settings.unknown, UNKNOWN))
        if settings.stale != IGNORE and self._unwatched and is_driving:
            ends = within_reach(self._unwatched, moved, reach_m)
            allowances.append(self._into_unknown(ends, motion, settings.stale, UNWATCHED))
        if self._moving:
            allowances += [self._before_moving(moved, age_s, motion), self._beside_moving(moved, age_s, motion)]
        return min(allowances)

    def _without_ring(self, age_s: float, motion: Twist) -> Allowance | None:
        """Return the allowance that the settings give where no recent ring shows anything; None: a ring does.

        age_s: of the ring's images.
        """
        settings = self._settings
        is_stale = not abs(age_s) <= settings.stale_s or not self._motions.reach_back_to(self._stamp_ns or 0)
        if settings.stale == IGNORE:
            return FREE if is_stale else None
        if not is_stale and not self._is_blind:
            return None
        most_mps = 0.0 if settings.stale == STOP else settings.slow_mps
        return self._capped(motion, most_mps, RING_STALE if is_stale else UNSEEN)

    def _driven_over(self, moved: Pose2, velocity_mps: float) -> str:
        """Return the reason to stop if the base drove over what the ring shows ahead of it, else an empty string."""
        settings = self._settings
        for points, policy, reason in (
            (self._points, STOP, BLOCKED),
            (self._unknown + self._gaps, settings.unknown, UNKNOWN),
            (self._unwatched, settings.stale, UNWATCHED),
        ):
            if policy == STOP and driven_over(self._outline, points, moved, velocity_mps):
                return reason
        return ""

    def _reach_m(self, speed_mps: float) -> float:
        """Return the distance within which obstacles matter: of the way to a stop, or of time_s if that is longer."""
        settings = self._settings
        way_m = max(speed_mps * settings.time_s, speed_mps**2 / (2 * BRAKING_SHARE * self._deceleration))
        reach_m = max(settings.stop_m + settings.slow_m, settings.side_m, settings.slow_side_m)
        return reach_m + (way_m + self._outline.radius_m)

    def _before(self, points: list[Point], motion: Twist) -> Allowance:
        """Keep the time to collision, and stop before what is in the stop polygon."""
        share = self._share_before(points, motion)
        return FREE if share >= 1.0 else Allowance(share, BLOCKED if share == 0.0 else NEAR)

    def _share_before(self, points: list[Point], motion: Twist, slope: float = 0.0) -> float:
        """Return the share before points; slope: those in the stop polygon count where the way to them is steeper."""
        settings, least_mps = self._settings, max(slope * abs(motion.velocity_mps), TINY)
        stop = self._stop_polygon(motion)
        inside, outside = stop.parted(points)
        if any(self._outline.approach_mps(x, y, motion) > least_mps for x, y in inside):
            return 0.0
        first_s = contact_s(stop, motion, outside)
        if first_s == math.inf:
            return 1.0
        share, speed_mps = first_s / settings.time_s, abs(motion.velocity_mps)
        turn_radps = max(abs(motion.yaw_rate_radps), TINY)
        share = min(share, math.sqrt(2 * BRAKING_SHARE * self._turn_deceleration * first_s / turn_radps))
        if speed_mps > 0.0:
            way_m = speed_mps * first_s
            share = min(share, math.sqrt(2 * BRAKING_SHARE * self._deceleration * way_m) / speed_mps)
            if share < 1.0 and share * speed_mps < LEAST_MPS:
                return 0.0
        return min(1.0, share)

    def _stop_polygon(self, motion: Twist) -> Outline:
        """Return the outline with the distance to keep on the side to which the base moves, and at its sides."""
        (front_m, rear_m, half_width_m), settings = self._outline, self._settings
        ahead_m = settings.stop_m if motion.velocity_mps > 0.0 else 0.0
        behind_m = settings.stop_m if motion.velocity_mps < 0.0 else 0.0
        return Outline(front_m + ahead_m, rear_m + behind_m, half_width_m + settings.side_m)

    def _near(self, points: list[Point], motion: Twist) -> Allowance:
        """Drive slowly while something is in the slow polygon, on the side to which the base moves."""
        settings, outline = self._settings, self._outline
        if abs(motion.velocity_mps) <= settings.slow_mps:
            return FREE
        wide_m = outline.half_width_m + settings.slow_side_m
        side = math.copysign(1.0, motion.velocity_mps)
        far_m = (outline.front_m if side > 0 else outline.rear_m) + settings.slow_m
        is_near = any(0.0 <= side * x <= far_m and abs(y) <= wide_m for x, y in points)
        return self._capped(motion, settings.slow_mps, NEAR) if is_near else FREE

    def _ahead(self, points: list[Point], motion: Twist) -> list[Point]:
        """Return the points beyond the edge that leads; all of them for a turn on the spot."""
        (front_m, rear_m, _), v = self._outline, motion.velocity_mps
        return [(x, y) for x, y in points if v == 0.0 or (x > front_m if v > 0.0 else x < -rear_m)]

    def _into_unknown(self, unknown: list[Point], motion: Twist, policy: str, reason: str) -> Allowance:
        """Slow down towards the end of what was seen to be free, and drive into what was not slowly, or not at all.

        policy: STOP or SLOW.
        """
        edge_mps = abs(motion.velocity_mps)
        if motion.velocity_mps == 0.0:
            # Corners may swing as far as floor was seen. An unknown region at the outline itself does not count: it
            # would keep the base from turning away.
            unknown = self._stop_polygon(motion).parted(unknown)[1]
            edge_mps = abs(motion.yaw_rate_radps) * self._outline.radius_m
        least = 0.0 if policy == STOP else min(1.0, self._settings.slow_mps / edge_mps)
        share = max(self._share_before(unknown, motion, ALONG_SLOPE), least)
        return FREE if share >= 1.0 else Allowance(share, reason)

    def _before_moving(self, moved: Pose2, age_s: float, motion: Twist) -> Allowance:
        """Slow down by the time until a moving obstacle, at its predicted place, is where the base would then be, and
        to slow_mps where a new one may be there, within one sigma: two pairs show roughly where it goes.
        """
        settings, stop = self._settings, self._stop_polygon(motion)
        slow = FREE
        for step in range(round(MOVING_S / MOVING_STEP_S)):
            ahead_s = step * MOVING_STEP_S
            pose = composed(moved, along_arc(motion.velocity_mps, motion.yaw_rate_radps, ahead_s))
            at_s = age_s + ahead_s
            places = [
                (obstacle.x_m + obstacle.vx_mps * at_s, obstacle.y_m + obstacle.vy_mps * at_s)
                for obstacle in self._moving
            ]
            for obstacle, (x, y) in zip(self._moving, seen_from(pose, places), strict=True):
                gap_m = stop.gap_m(x, y) - obstacle.radius_m
                if not step and self._outline.approach_mps(x, y, motion) <= TINY:
                    continue
                if gap_m <= 0.0:
                    share = 0.0 if ahead_s <= MOVING_STOP_S else ahead_s / MOVING_S
                    return min(slow, Allowance(share, MOVING))
                spread_m = math.hypot(obstacle.sigma_m, at_s * obstacle.sigma_mps)
                if slow is FREE and obstacle.sigma_mps > NEW_MPS and gap_m <= spread_m:
                    slow = self._capped(
                        motion, max(settings.slow_mps, abs(motion.velocity_mps) * ahead_s / MOVING_S), MOVING
                    )
        return slow

    def _beside_moving(self, moved: Pose2, age_s: float, motion: Twist) -> Allowance:
        """Drive so slowly next to a person that the base is at rest before that person, or a hidden one, reaches it.

        The person may turn round. With a gap g: `g = WALK_MPS (TURN_S + v / a)`. Persons behind the base do not count.
        """
        side, braking_mps2 = math.copysign(1.0, motion.velocity_mps), BRAKING_SHARE * self._deceleration
        now = [(one.x_m + one.vx_mps * age_s, one.y_m + one.vy_mps * age_s) for one in self._moving]
        gaps_m = [
            self._outline.gap_m(x, y) - obstacle.radius_m
            for obstacle, (x, y) in zip(self._moving, seen_from(moved, now), strict=True)
            if side * x > 0.0
        ]
        limit_mps = braking_mps2 * (min(gaps_m, default=math.inf) / WALK_MPS - TURN_S)
        if motion.velocity_mps == 0.0 or abs(motion.velocity_mps) <= limit_mps:
            return FREE
        return self._capped(motion, max(self._settings.slow_mps, limit_mps), MOVING)

    def _capped(self, motion: Twist, speed_mps: float, reason: str) -> Allowance:
        """Return the share at which the speed is at most so high; turns on the spot slow down alike."""
        if speed_mps <= 0.0:
            return Allowance(0.0, reason)
        edge_mps = max(abs(motion.velocity_mps), abs(motion.yaw_rate_radps) * self._outline.radius_m)
        return FREE if edge_mps <= speed_mps else Allowance(speed_mps / edge_mps, reason)
