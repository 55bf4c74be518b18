"""Paths on the floor: points at equal distances, in legs between sharp corners and changes of direction."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.se2_arrays import composed, wrapped
from omnid.errors import OmnidError

Array = NDArray[np.float64]

STEP_M: Final = 0.05  # Spacing of the points: a cell of the grid.
SHORTEST_M: Final = 2 * STEP_M  # Nearer points of a given path are dropped, because they are noise of the position.
CORNER_RAD: Final = math.radians(40)  # At sharper corners the base turns on the spot; by trial on development seeds.
MAX_POINTS: Final = 20_000  # Most points of a given path, so that a message has at most 320 kB of coordinates.
MAX_LENGTH_M: Final = 5_000.0  # so that memory is bounded: 100,000 points
FARTHEST_M: Final = 1e6  # Largest coordinate, so that nonsense is refused: larger than any site.


@dataclass(frozen=True, slots=True, eq=False)
class DrivePath:
    """Points of all legs; where a leg ends and another one begins are two points. s: arc length from the start."""

    xy: Array  # (N, 2) positions [m]
    s: Array  # (N,) m
    heading: Array  # (N,) direction of the path [rad], not wrapped
    curvature: Array  # (N,) 1/m
    speed: Array  # (N,) highest speed, m/s; below 0: the base drives with its back ahead
    ends: NDArray[np.intp]  # (L,) last points of the legs
    final_heading_rad: float | None = None  # of the base at the end; None: any
    is_goal: bool = False  # only its end matters: any way there will do

    @property
    def length_m(self) -> float:
        """Length of the way."""
        return float(self.s[-1])

    @property
    def goal(self) -> Array:
        """Position of the end (2,)."""
        return np.asarray(self.xy[-1])

    def moved(self, T: Array) -> DrivePath:
        """Return the path in axes in which its own have the pose T (3,)."""
        poses = composed(T[None], np.column_stack([self.xy, self.heading]))
        final_rad = None if self.final_heading_rad is None else self.final_heading_rad + float(T[2])
        return replace(self, xy=poses[:, :2], heading=poses[:, 2], final_heading_rad=final_rad)

    def leg(self, number: int) -> slice:
        """Return the points of a leg."""
        return slice(int(self.ends[number - 1]) + 1 if number else 0, int(self.ends[number]) + 1)

    def at(self, number: int, s_m: float) -> Array:
        """Return x, y, heading (3,) at an arc length on a leg, which continues straight beyond its ends."""
        leg = self.leg(number)
        s, columns = self.s[leg], (self.xy[leg, 0], self.xy[leg, 1], self.heading[leg])
        x, y, heading = (float(np.interp(s_m, s, column)) for column in columns)
        beyond = s_m - min(max(s_m, float(s[0])), float(s[-1]))
        return np.array([x + beyond * math.cos(heading), y + beyond * math.sin(heading), heading])

    def project(self, number: int, position: Array, around_m: float) -> float:
        """Return the arc length of the point of a leg nearest to a position (2,), beyond its end on a straight line.

        It is searched half a metre behind a known arc length [m] and two ahead, so that a leg may cross itself.
        """
        leg = self.leg(number)
        near = leg.start + np.searchsorted(self.s[leg], (around_m - 0.5, around_m + 2.0))
        first = max(int(near[0]) - 1, leg.start)
        k = first + int(np.argmin(np.hypot(*(self.xy[first : min(near[1] + 2, leg.stop)] - position[:2]).T)))
        dx, dy = position[:2] - self.xy[k]
        along_m = math.cos(self.heading[k]) * dx + math.sin(self.heading[k]) * dy
        return float(self.s[k] + max(-STEP_M, min(along_m, math.inf if k == leg.stop - 1 else STEP_M)))


def drive_path(
    points: ArrayLike,
    final_heading_rad: float | None = None,
    *,
    speeds: ArrayLike | None = None,
    is_goal: bool = False,
) -> DrivePath:
    """Return the path through points (N, 2) [m], in legs that end at corners and where the direction changes.

    speeds: (N,) highest speeds, m/s, below 0 where the base comes there with its back ahead. Raise OmnidError for
    points that are no path.
    """
    given = np.asarray(points, np.float64).reshape(-1, 2)
    limits = np.full(len(given), math.inf) if speeds is None else np.asarray(speeds, np.float64)
    # 1. What is no path.
    if not 2 <= len(given) <= MAX_POINTS:
        raise OmnidError(f"a path of {len(given)} points: expected 2 to {MAX_POINTS}")
    if not np.isfinite(given).all():
        raise OmnidError("a path has positions that are not finite")
    length_m = float(np.hypot(*np.diff(given, axis=0).T).sum())
    if length_m > MAX_LENGTH_M or (length_m == 0.0 and not is_goal):
        raise OmnidError(f"a path has no length, or is longer than {MAX_LENGTH_M:g} m")
    # 2. Points at least SHORTEST_M apart, and the last one.
    kept, last = [0], len(given) - 1
    for k in range(1, last):
        if math.dist(given[k], given[kept[-1]]) >= SHORTEST_M:
            kept.append(k)
    if len(kept) > 1 and math.dist(given[last], given[kept[-1]]) < SHORTEST_M:
        kept.pop()
    xy, limits = given[[*kept, last]], limits[[*kept, last]]
    # 3. Legs between corners.
    headings = np.arctan2(*np.diff(xy, axis=0).T[::-1])
    is_corner = (np.abs(wrapped(np.diff(headings))) > CORNER_RAD) | (limits[1:-1] * limits[2:] < 0)
    ends = [0, *(np.flatnonzero(is_corner) + 1).tolist(), len(xy) - 1]
    legs = [_leg(xy[a : b + 1], limits[a + 1 : b + 1]) for a, b in itertools.pairwise(ends)]
    lengths = np.array([len(leg[0]) for leg in legs])
    begins = np.append(0.0, np.cumsum([leg[1][-1] for leg in legs]))
    xy, s, heading, curvature, speed = (np.concatenate(parts) for parts in zip(*legs, strict=True))
    s += np.repeat(begins[:-1], lengths)
    return DrivePath(xy, s, heading, curvature, speed, np.cumsum(lengths) - 1, final_heading_rad, is_goal)


def _leg(xy: Array, speeds: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Return the columns of DrivePath of a leg through points (N, 2) with the highest speeds (N - 1,) between them."""
    ways = np.append(0.0, np.cumsum(np.hypot(*np.diff(xy, axis=0).T)))
    count = max(2, math.ceil(ways[-1] / STEP_M) + 1)
    s = np.linspace(0.0, ways[-1], count)
    fine = np.column_stack([np.interp(s, ways, xy[:, 0]), np.interp(s, ways, xy[:, 1])])
    # Headings over some steps: those of single ones would show the corners between the given points.
    reach = 2 if count > 4 else 1
    ahead, behind = np.minimum(np.arange(count) + reach, count - 1), np.maximum(np.arange(count) - reach, 0)
    d = fine[ahead] - fine[behind]
    heading = np.unwrap(np.arctan2(d[:, 1], d[:, 0]))
    curvature = (heading[ahead] - heading[behind]) / np.maximum(s[ahead] - s[behind], STEP_M)
    return fine, s, heading, curvature, speeds[np.searchsorted(ways[1:-1], s)]
