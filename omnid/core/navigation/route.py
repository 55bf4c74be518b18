"""Routes: taught once by driving, repeated along the same way in the map.

A route is tied to keyframes of the map: where an optimisation of the map moves them, the route moves with them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import composed, relative, wrapped
from omnid.core.navigation.path import MAX_LENGTH_M, SHORTEST_M, DrivePath, drive_path
from omnid.core.places.place_map import NO_KEYFRAME
from omnid.errors import OmnidError

Array = NDArray[np.float64]

MOST_POINTS: Final = 15_000  # Points of a route, so that it is bounded: 1.5 km.
LEAST_MPS: Final = 0.1  # Slower parts of the recording are repeated at this speed.
SAME_MAP: Final = 0.3  # share of the keyframes noted with a route that must be in the map
ENTRY_M: Final = 1.0  # most distance of the robot from a route that it repeats, and between the ends of a closed one
DECIMALS: Final = 6  # Decimals of a route, as in its file, so that reading it changes nothing.
FarKeyframe = Callable[[int], "KeyframePose | None"]


class KeyframePose(NamedTuple):
    """A keyframe of the map."""

    stamp_ns: int  # stamp of its images: another map may have another keyframe of the same number
    pose: Array  # x, y, yaw (3,) of the base in the map


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """A recorded way; all points in the frame map as it was at the end of the recording."""

    name: str
    poses: Array  # (N, 3) x, y, yaw of the base
    speeds: Array  # (N,) m/s with which each point was reached, below 0 with the back ahead
    keyframes: NDArray[np.int64]  # (N,) that the points are tied to, NO_KEYFRAME without
    in_keyframe: Array  # (N, 3) pose in it
    stamps_ns: Mapping[int, int]  # stamps by id of keyframes of the map, those of the points and others
    created_s: int = 0  # Unix time
    map_name: str = ""

    @property
    def length_m(self) -> float:
        """Length of the way."""
        return float(_ways_m(self.poses)[-1])

    @property
    def is_closed(self) -> bool:
        """True if the route ends at its start: then it is driven in rounds."""
        return math.dist(self.poses[0, :2], self.poses[-1, :2]) <= ENTRY_M

    def fits(self, keyframe: FarKeyframe) -> bool:
        """True if a map holds the keyframes that were noted, by their stamps."""
        found = sum((now := keyframe(id)) is not None and now.stamp_ns == stamp for id, stamp in self.stamps_ns.items())
        return found > 0 and found >= SAME_MAP * len(self.stamps_ns)

    def in_map(self, keyframe: FarKeyframe) -> Array:
        """Return the poses (N, 3) in the map of now; those of dropped keyframes move with their neighbours."""
        moved = np.full((len(self.poses), 3), np.nan)
        for id in np.unique(self.keyframes):
            now = keyframe(int(id)) if id != NO_KEYFRAME else None
            if now is not None and now.stamp_ns == self.stamps_ns.get(int(id)):
                at = self.keyframes == id
                moved[at] = composed(np.repeat(now.pose[None], at.sum(), 0), self.in_keyframe[at])
        known = np.isfinite(moved[:, 0])
        if not known.any():
            return self.poses
        points = np.arange(len(self.poses))
        shift = moved - self.poses
        shift[:, 2] = wrapped(shift[:, 2])
        filled = np.column_stack([np.interp(points, points[known], shift[known, axis]) for axis in range(3)])
        return np.asarray(self.poses + filled)

    def reversed(self) -> Route:
        """Return the route from its end to its start; the base turns round and drives it the same way ahead."""
        half_turn = np.array([0.0, 0.0, math.pi])
        speeds = np.concatenate([self.speeds[1:], self.speeds[-1:]])[::-1]  # a speed belongs to the step before it
        return replace(
            self,
            poses=composed(self.poses[::-1], half_turn),
            speeds=speeds,
            keyframes=self.keyframes[::-1],
            in_keyframe=composed(self.in_keyframe[::-1], half_turn),
        )


class RouteRecorder:
    """Collects the points of a route while it is driven."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.length_m = 0.0
        self._points: list[tuple[Array, float, int, Array]] = []
        self._newest: tuple[Array, float, int, Array] | None = None  # where the recording ends

    def add(self, pose: Array, speed_mps: float, keyframe: int, keyframe_pose: Array) -> None:
        """Add a pose (3,) of the base in the map where it has moved; keyframe_pose (3,): of its keyframe.

        Raise OmnidError for a route that gets too long.
        """
        moved_m = math.inf
        if self._points:
            step = relative(self._points[-1][0], pose)
            moved_m = math.hypot(step[0], step[1])
            # The sign of the speed is that of the step, and of a turn on the spot that of the point before.
            speed_mps = math.copysign(speed_mps, step[0] if moved_m > SHORTEST_M / 2 else self._points[-1][1])
        self._newest = pose, speed_mps, keyframe, relative(keyframe_pose, pose)
        if moved_m < SHORTEST_M and abs(float(wrapped(step[2]))) < math.radians(10):
            return
        self.length_m += moved_m if self._points else 0.0
        if len(self._points) >= MOST_POINTS - 1 or self.length_m > MAX_LENGTH_M:
            raise OmnidError(f"the route {self.name} is too long: {len(self._points)} points, {self.length_m:.0f} m")
        self._points.append(self._newest)

    def route(self, keyframe: FarKeyframe, noted: Mapping[int, int], created_s: int, map_name: str) -> Route:
        """Return the route in the map as it is now; noted: stamps of keyframes that identify the map.

        Raise OmnidError for one that is too short.
        """
        if self._newest is None or self.length_m < 5 * SHORTEST_M:
            raise OmnidError(
                f"the route {self.name} is {self.length_m:.2f} m long, which is too short: drive it, then finish; "
                "`omnid route stop` drops it"
            )
        poses, speeds, keyframes, in_keyframe = zip(*self._points, self._newest, strict=True)
        stamps = dict(noted)
        for id in set(keyframes):
            found = keyframe(id) if id != NO_KEYFRAME else None
            if found is not None:
                stamps[id] = found.stamp_ns
        of_points = np.array(speeds).round(DECIMALS), np.array(keyframes, np.int64), np.array(in_keyframe)
        route = Route(self.name, np.array(poses), *of_points, stamps, created_s, map_name)
        rounded = route.in_map(keyframe).round(DECIMALS), route.in_keyframe.round(DECIMALS)
        return replace(route, poses=rounded[0], in_keyframe=rounded[1])


def repeated_paths(route: Route, keyframe: FarKeyframe, pose: Array, *, loops: int, reverse: bool) -> list[DrivePath]:
    """Return the paths that repeat a route from the nearest point on it to a pose (3,) of the base in the map.

    A closed route is driven in rounds, any other there and back, `loops` times in all. Raise OmnidError where
    the robot is not near it, or at the end of the only way.
    """
    there = route.reversed() if reverse else route
    poses = there.in_map(keyframe)
    # 1. The robot begins at the nearest point by place and heading, of which a radian counts as half a metre. Where a
    #    closed route ends, a new round begins.
    away_m, ways_m = np.hypot(*(poses[:, :2] - pose[:2]).T), _ways_m(poses)
    cost_m = away_m + 0.5 * np.abs(wrapped(poses[:, 2] - pose[2]))
    cost_m[away_m > ENTRY_M] = math.inf
    if route.is_closed and np.isfinite(cost_m[ways_m < ways_m[-1] - ENTRY_M]).any():
        cost_m[ways_m >= ways_m[-1] - ENTRY_M] = math.inf
    if away_m.min() > ENTRY_M:
        raise OmnidError(f"the robot is {away_m.min():.1f} m away from the route: drive it to within {ENTRY_M:g} m")
    first = int(np.argmin(cost_m))
    if loops == 1 and ways_m[-1] - ways_m[first] <= 2 * SHORTEST_M:
        raise OmnidError("the robot is at the end of the route: repeat it in reverse, or drive to its start first")
    # 2. The rest of the round, and the others.
    rounds = [there] if route.is_closed else [there, there.reversed()]
    ways = [_path(each, each.in_map(keyframe)) for each in rounds[:loops]]
    return [_path(there, poses, first), *(ways[k % len(ways)] for k in range(1, loops))]


def _path(route: Route, poses: Array, first: int = 0) -> DrivePath:
    """Return the path from a point of the route on."""
    first = min(first, len(poses) - 2)
    speeds = np.copysign(np.maximum(np.abs(route.speeds[first:]), LEAST_MPS), route.speeds[first:])
    return drive_path(poses[first:, :2], float(poses[-1, 2]), speeds=speeds)


def _ways_m(poses: Array) -> Array:
    """Return the way (N,) to each of some poses (N, 3)."""
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
