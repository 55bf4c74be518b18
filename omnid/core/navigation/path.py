"""Paths on the floor: points at equal distances with headings and curvature, in legs between sharp corners."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.se2_arrays import wrapped
from omnid.core.control.heading_controller import wrap_angle
from omnid.errors import OmnidError

Array = NDArray[np.float64]

STEP_M: Final = 0.05  # Spacing of the points: a cell of the grid.
SHORTEST_M: Final = 2 * STEP_M  # Nearer points of a given path are dropped, because they are noise of the position.
CORNER_RAD: Final = math.radians(40)  # At sharper corners the base turns on the spot; by trial on development seeds.
BACK_M, AHEAD_M = 0.5, 2.0  # of the path, in which the nearest point is searched, so that a path may cross itself
MAX_POINTS: Final = 20_000  # Most points of a given path, so that a message has at most 320 kB of coordinates.
MAX_LENGTH_M: Final = 5_000.0  # so that memory is bounded: 100,000 points
FARTHEST_M: Final = 1e6  # Largest coordinate, so that nonsense is refused: larger than any site.


@dataclass(frozen=True, slots=True, eq=False)
class PathLeg:
    """A smooth piece of a path, driven without a stop. A position on it is given by the arc length s from its start."""

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

    def project(self, position: Array, around_m: float) -> float:
        """Return the arc length of the point nearest to a position (2,), searched around a known arc length [m].

        Past the end it continues along the last heading, so that it gives the distance past the end.
        """
        first, last = np.searchsorted(self.s, (around_m - BACK_M, around_m + AHEAD_M))
        first = max(0, first - 1)
        k = first + int(np.argmin(np.hypot(*(self.xy[first : last + 2] - position[:2]).T)))
        dx, dy = position[:2] - self.xy[k]
        along_m = math.cos(self.heading[k]) * dx + math.sin(self.heading[k]) * dy
        limit_m = math.inf if k == len(self.s) - 1 else STEP_M
        return float(self.s[k] + max(-STEP_M, min(limit_m, along_m)))

    def at(self, s_m: float) -> Array:
        """Return x, y, heading (3,) at an arc length; beyond the ends the path continues straight."""
        inside = min(max(s_m, 0.0), self.length_m)
        x, y, heading = (float(np.interp(inside, self.s, v)) for v in (self.xy[:, 0], self.xy[:, 1], self.heading))
        beyond = s_m - inside
        return np.array([x + beyond * math.cos(heading), y + beyond * math.sin(heading), heading])


class PathPlace(NamedTuple):
    """A place on a path."""

    leg: int  # its number; past the last one: the end
    s_m: float  # way on the leg


BEGIN: Final = PathPlace(0, 0.0)


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


def drive_path(points: ArrayLike, final_heading_rad: float | None = None, *, speeds: ArrayLike = math.inf) -> DrivePath:
    """Return the path through points (N, 2) [m], in legs that end at corners and where the direction changes.

    speeds: (N,) or of all, highest speeds with which the points are reached, m/s; below 0 with the back ahead.
    Raise OmnidError for points that are no path.
    """
    given = np.asarray(points, np.float64).reshape(-1, 2)
    if not 2 <= len(given) <= MAX_POINTS:
        raise OmnidError(f"a path of {len(given)} points: expected 2 to {MAX_POINTS}")
    if not np.isfinite(given).all():
        raise OmnidError("a path has positions that are not finite")
    if np.hypot(*np.diff(given, axis=0).T).sum() > MAX_LENGTH_M:
        raise OmnidError(f"a path is longer than {MAX_LENGTH_M:g} m")
    limits = np.broadcast_to(np.asarray(speeds, np.float64), len(given))
    kept = _spaced(given, limits < 0)
    xy, limits, back = given[kept], np.abs(limits[kept]), limits[kept] < 0
    if len(xy) < 2:
        raise OmnidError(f"a path is shorter than {SHORTEST_M:g} m")
    headings = np.arctan2(*np.diff(xy, axis=0).T[::-1])
    is_corner = (np.abs(wrapped(np.diff(headings))) > CORNER_RAD) | (back[1:-1] != back[2:])
    ends = [0, *(np.flatnonzero(is_corner) + 1).tolist(), len(xy) - 1]
    legs = tuple(_leg(xy[a : b + 1], limits[a : b + 1], bool(back[b])) for a, b in itertools.pairwise(ends))
    return DrivePath(legs, None if final_heading_rad is None else wrap_angle(final_heading_rad))


def goal_path(pose: ArrayLike, goal: ArrayLike, heading_rad: float | None = None) -> DrivePath:
    """Return the straight way from a pose (3,) to a goal (2,), which any other way may replace."""
    return DrivePath((straight_leg(pose, goal),), heading_rad, True)


def ways_m(path: Array) -> Array:
    """Return the way (N,) along a path (N, 2), or along poses (N, 3), to each of its points."""
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T)))


def straight_leg(start: ArrayLike, goal: ArrayLike, *, backwards: bool = False) -> PathLeg:
    """Return the straight way between two positions (2,), however near they are."""
    ends = np.array([np.asarray(end, np.float64)[:2] for end in (start, goal)])
    return _leg(ends, np.full(2, math.inf), backwards)


def _spaced(xy: Array, back: NDArray[np.bool_]) -> list[int]:
    """Return the indices of points at least SHORTEST_M apart; the last point is kept in any case."""
    kept, last = [0], len(xy) - 1
    for k in range(1, last):
        if math.dist(xy[k], xy[kept[-1]]) >= SHORTEST_M:
            kept.append(k)
    away_m = math.dist(xy[last], xy[kept[-1]])
    if away_m < SHORTEST_M and len(kept) > 1 and back[last] == back[kept[-1]]:
        kept.pop()
    return kept if len(kept) == 1 and away_m == 0 else [*kept, last]


def _leg(xy: Array, speeds: Array, backwards: bool) -> PathLeg:
    """Return the leg through points (N, 2) with highest speeds (N,), sampled at equal distances."""
    ways = ways_m(xy)
    count = max(2, math.ceil(ways[-1] / STEP_M) + 1)
    s = np.linspace(0.0, ways[-1], count)
    fine = np.column_stack([np.interp(s, ways, xy[:, 0]), np.interp(s, ways, xy[:, 1])])
    # Headings over some steps: those of single ones would show the corners between the given points.
    reach = 2 if count > 4 else 1
    ahead, behind = np.minimum(np.arange(count) + reach, count - 1), np.maximum(np.arange(count) - reach, 0)
    d = fine[ahead] - fine[behind]
    heading = np.unwrap(np.arctan2(d[:, 1], d[:, 0]))
    curvature = (heading[ahead] - heading[behind]) / np.maximum(s[ahead] - s[behind], 1e-9)
    speed = speeds[np.searchsorted(ways, s).clip(0, len(ways) - 1)]
    return PathLeg(fine, s, heading, curvature, speed, backwards)
