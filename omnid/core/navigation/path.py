"""Paths on the floor: points at equal distances with headings and curvature, in legs between sharp corners."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.se2_arrays import wrapped
from omnid.core.control.heading_controller import wrap_angle
from omnid.errors import OmnidError

Array = NDArray[np.float64]

STEP_M: Final = 0.05  # Spacing of the points; fine enough: a cell of the local planner.
SHORTEST_M: Final = 0.1  # Nearer points of a given path are dropped, because they are noise of the position.
CORNER_RAD: Final = math.radians(40)  # At sharper corners the base turns on the spot; by trial on development seeds.
BACK_M, AHEAD_M = 0.5, 2.0  # of the path, in which the nearest point is searched, so that a path may cross itself
MAX_POINTS: Final = 20_000  # Most points of a given path, so that a message has at most 320 kB of coordinates.
MAX_LENGTH_M: Final = 5_000.0  # so that memory is bounded: 100,000 points
FARTHEST_M: Final = 1e6  # Largest coordinate, so that nonsense is refused: larger than any site.


@dataclass(frozen=True, slots=True, eq=False)
class PathLeg:
    """A smooth piece of a path, driven without a halt. A position on it is given by the arc length s from its start."""

    xy: Array  # (N, 2) positions [m], N >= 2
    s: Array  # (N,) arc length from the start [m]
    heading: Array  # (N,) direction of the path [rad], not wrapped
    curvature: Array  # (N,) 1/m
    speed: Array  # (N,) highest speed, m/s
    backwards: bool = False  # the base drives with its back ahead

    @property
    def length_m(self) -> float:
        """Length of the way."""
        return float(self.s[-1])

    def project(self, position: ArrayLike, around_m: float) -> float:
        """Return the arc length of the point nearest to a position (2,), searched around a known arc length [m].

        Past the end it continues along the last heading, so that it gives the distance past the end.
        """
        x, y = np.asarray(position, np.float64)[:2]
        first = max(0, int(np.searchsorted(self.s, around_m - BACK_M)) - 1)
        last = min(len(self.s), int(np.searchsorted(self.s, around_m + AHEAD_M)) + 2)
        d = np.hypot(self.xy[first:last, 0] - x, self.xy[first:last, 1] - y)
        k = first + int(np.argmin(d))
        dx, dy = x - self.xy[k, 0], y - self.xy[k, 1]
        along_m = math.cos(self.heading[k]) * dx + math.sin(self.heading[k]) * dy
        limit_m = math.inf if k == len(self.s) - 1 else STEP_M
        return float(self.s[k] + max(-STEP_M, min(limit_m, along_m)))

    def at(self, s_m: float) -> Array:
        """Return x, y, heading (3,) at an arc length; beyond the ends the path continues straight."""
        inside = min(max(s_m, 0.0), self.length_m)
        x, y, heading = (float(np.interp(inside, self.s, v)) for v in (self.xy[:, 0], self.xy[:, 1], self.heading))
        beyond = s_m - inside
        return np.array([x + beyond * math.cos(heading), y + beyond * math.sin(heading), heading])

    def offset_m(self, position: ArrayLike, s_m: float) -> float:
        """Return the distance [m] of a position (2,) to the left of the path at an arc length."""
        x, y, heading = self.at(s_m)
        px, py = np.asarray(position, np.float64)[:2]
        return float(math.cos(heading) * (py - y) - math.sin(heading) * (px - x))

    def sharpest(self, s_m: float, ahead_m: float) -> float:
        """Return the largest curvature in magnitude within a distance ahead, 1/m."""
        within = (self.s >= s_m - STEP_M) & (self.s <= s_m + ahead_m)
        return float(np.abs(self.curvature[within]).max(initial=0.0))

    def speed_at(self, s_m: float) -> float:
        """Return the highest speed [m/s] at an arc length."""
        return float(self.speed[min(len(self.s) - 1, int(np.searchsorted(self.s, s_m)))])


@dataclass(frozen=True, slots=True, eq=False)
class DrivePath:
    """Legs in their order, and the heading of the base at the end."""

    legs: tuple[PathLeg, ...]
    final_heading_rad: float | None = None  # None: any heading
    is_goal: bool = False  # only its end matters: any way there will do

    @property
    def length_m(self) -> float:
        """Length of the way."""
        return sum(leg.length_m for leg in self.legs)

    @property
    def goal(self) -> Array:
        """Position of the end (2,)."""
        return np.asarray(self.legs[-1].xy[-1])


def drive_path(
    points: ArrayLike,
    final_heading_rad: float | None = None,
    *,
    speeds: ArrayLike | None = None,
    backwards: Sequence[bool] | None = None,
) -> DrivePath:
    """Return the path through points (N, 2) [m], in legs that end at corners and where the direction changes.

    speeds: (N,) highest speeds, m/s. backwards: of N points, True where the base came there with its back ahead.
    Raise OmnidError for points that are no path.
    """
    given = np.asarray(points, np.float64).reshape(-1, 2)
    if not 2 <= len(given) <= MAX_POINTS:
        raise OmnidError(f"a path of {len(given)} points: expected 2 to {MAX_POINTS}")
    if not np.isfinite(given).all():
        raise OmnidError("a path has positions that are not finite")
    limits = np.full(len(given), math.inf) if speeds is None else np.asarray(speeds, np.float64)
    back = np.zeros(len(given), bool) if backwards is None else np.asarray(backwards, bool)
    if np.hypot(*np.diff(given, axis=0).T).sum() > MAX_LENGTH_M:
        raise OmnidError(f"a path is longer than {MAX_LENGTH_M:g} m")
    kept = _spaced(given, back)
    given, limits, back = given[kept], limits[kept], back[kept]
    if len(given) < 2:
        raise OmnidError(f"a path is shorter than {SHORTEST_M:g} m")
    ends = [0, *_corners(given, back), len(given) - 1]
    legs = tuple(_leg(given[a : b + 1], limits[a : b + 1], bool(back[b])) for a, b in itertools.pairwise(ends))
    return DrivePath(legs, None if final_heading_rad is None else wrap_angle(final_heading_rad))


def goal_path(pose: ArrayLike, goal: ArrayLike, heading_rad: float | None = None) -> DrivePath:
    """Return the straight way from a pose (3,) to a goal (2,), which any other way may replace."""
    return DrivePath((straight_leg(pose, goal),), heading_rad, True)


def straight_leg(start: ArrayLike, goal: ArrayLike, *, backwards: bool = False) -> PathLeg:
    """Return the straight way between two positions (2,), however near they are."""
    return _leg(
        np.array([np.asarray(start, np.float64)[:2], np.asarray(goal, np.float64)[:2]]), np.full(2, math.inf), backwards
    )


def _spaced(xy: Array, back: NDArray[np.bool_]) -> list[int]:
    """Return the indices of points at least SHORTEST_M apart; the last point is kept in any case."""
    kept = [0]
    for k in range(1, len(xy)):
        if math.dist(xy[k], xy[kept[-1]]) >= SHORTEST_M:
            kept.append(k)
    if kept[-1] != len(xy) - 1:
        if len(kept) > 1 and math.dist(xy[-1], xy[kept[-1]]) < SHORTEST_M and back[-1] == back[kept[-1]]:
            kept.pop()
        kept.append(len(xy) - 1)
    return kept if math.dist(xy[kept[0]], xy[kept[-1]]) > 0 or len(kept) > 2 else kept[:1]


def _corners(xy: Array, back: NDArray[np.bool_]) -> list[int]:
    """Return the inner points at which the way turns sharply or the base changes between forwards and backwards."""
    steps = np.diff(xy, axis=0)
    headings = np.arctan2(steps[:, 1], steps[:, 0])
    sharp = np.abs(wrapped(np.diff(headings))) > CORNER_RAD
    return [int(k) + 1 for k in np.flatnonzero(sharp | (back[1:-1] != back[2:]))]


def _leg(xy: Array, speeds: Array, backwards: bool) -> PathLeg:
    """Return the leg through points (N, 2) with highest speeds (N,), sampled at equal distances."""
    lengths = np.hypot(*np.diff(xy, axis=0).T)
    ways = np.concatenate([[0.0], np.cumsum(lengths)])
    count = max(2, math.ceil(ways[-1] / STEP_M) + 1)
    s = np.linspace(0.0, ways[-1], count)
    fine = np.column_stack([np.interp(s, ways, xy[:, 0]), np.interp(s, ways, xy[:, 1])])
    # Headings over some steps: those of single ones would show the corners between the given points.
    reach = 2 if count > 4 else 1
    ahead, behind = np.minimum(np.arange(count) + reach, count - 1), np.maximum(np.arange(count) - reach, 0)
    d = fine[ahead] - fine[behind]
    heading = np.unwrap(np.arctan2(d[:, 1], d[:, 0]))
    span = np.maximum(s[ahead] - s[behind], 1e-9)
    curvature = (heading[ahead] - heading[behind]) / span
    speed = np.minimum(speeds[np.searchsorted(ways, s, side="left").clip(0, len(ways) - 1)], math.inf)
    return PathLeg(fine, s, heading, curvature, speed, backwards)
