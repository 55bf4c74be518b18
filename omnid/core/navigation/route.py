"""Routes: taught once by driving, repeated along the same way in the map.

A route is tied to keyframes of the map: where an optimisation of the map moves them, the route moves with them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import composed, relative, wrapped
from omnid.core.control.collision_monitor import LEAST_MPS as STANDING_MPS
from omnid.core.navigation.path import MAX_LENGTH_M, DrivePath, drive_path, ways_m
from omnid.errors import OmnidError

Array = NDArray[np.float64]

# Set by trial on development seeds, where a line gives no other reason.
SPACING_M, SPACING_RAD = 0.1, math.radians(10)  # Motion between two points of a recording.
MOST_POINTS: Final = 15_000  # Points of a route, so that it is bounded: 1.5 km.
SHORTEST_ROUTE_M: Final = 0.5
LEAST_MPS: Final = 0.1  # Slower parts of the recording are repeated at this speed.
SAME_MAP: Final = 0.3  # share of the keyframes noted with a route that must be in the map
CLOSED_M: Final = 1.0  # Most distance between the ends of a route that is driven in rounds.
ENTRY_M: Final = 1.5  # Most distance of the robot from a route that it repeats.
ENTRY_M_PER_RAD: Final = 0.5  # Cost of a radian of heading error where several pieces of a route are near.
BESIDE_M: Final = 0.25  # A robot that is farther from the route drives to it first.


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
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum())

    @property
    def is_closed(self) -> bool:
        """True if the route ends at its start: then it is driven in rounds."""
        return math.dist(self.poses[0, :2], self.poses[-1, :2]) <= CLOSED_M

    def fits(self, keyframes: Mapping[int, KeyframePose]) -> bool:
        """True if a map, of keyframes by id, holds enough of those in stamps_ns."""
        found = sum(id in keyframes and keyframes[id].stamp_ns == stamp for id, stamp in self.stamps_ns.items())
        return found > 0 and found >= SAME_MAP * len(self.stamps_ns)

    def in_map(self, keyframes: Mapping[int, KeyframePose]) -> Array:
        """Return the poses (N, 3) in the present map; those of dropped keyframes move with their neighbours."""
        moved = np.full((len(self.poses), 3), np.nan)
        for id in np.unique(self.keyframes).tolist():
            keyframe = keyframes.get(id)
            if keyframe is not None and keyframe.stamp_ns == self.stamps_ns.get(id):
                at = self.keyframes == id
                moved[at] = composed(np.repeat(keyframe.pose[None], at.sum(), 0), self.in_keyframe[at])
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


class RoutePoint(NamedTuple):
    """A point of a recording."""

    pose: Array  # x, y, yaw (3,) of the base in the map
    speed_mps: float
    keyframe: int  # id
    in_keyframe: Array  # (3,) pose in the keyframe


class RouteRecorder:
    """Collects the points of a route while it is driven."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.length_m = 0.0
        self._points: list[RoutePoint] = []
        self._newest: RoutePoint | None = None  # the end of the recording

    def add(self, pose: Array, speed_mps: float, keyframe: int, keyframe_pose: Array) -> None:
        """Add a pose (3,) of the base in the map where it has moved; keyframe_pose (3,): of its keyframe.

        Raise OmnidError for a route that gets too long.
        """
        self._newest = point = RoutePoint(pose, speed_mps, keyframe, relative(keyframe_pose, pose))
        if self._points:
            step = relative(self._points[-1].pose, pose)
            moved_m = math.hypot(step[0], step[1])
            if moved_m < SPACING_M and abs(float(wrapped(step[2]))) < SPACING_RAD:
                return
            self.length_m += moved_m
        if len(self._points) >= MOST_POINTS or self.length_m > MAX_LENGTH_M:
            raise OmnidError(f"the route {self.name} is too long: {len(self._points)} points, {self.length_m:.0f} m")
        if abs(speed_mps) < STANDING_MPS and self._points:
            point = point._replace(speed_mps=math.copysign(STANDING_MPS, self._points[-1].speed_mps))
        self._points.append(point)

    def route(self, keyframes: Mapping[int, KeyframePose], created_s: int, map_name: str) -> Route:
        """Return the route in the present map, of keyframes by id.

        Raise OmnidError for one that is too short.
        """
        if self._newest is None or self.length_m < SHORTEST_ROUTE_M:
            raise OmnidError(
                f"the route {self.name} is {self.length_m:.2f} m long: expected {SHORTEST_ROUTE_M:g} m "
                "and more: drive it, then finish; `omnid route stop` drops it"
            )
        # The last point is the end of the recording, however near to the point before it.
        points, last, newest = self._points, self._points[-1], self._newest
        step = relative(last.pose, newest.pose)
        if math.hypot(step[0], step[1]) <= 0.5 * SPACING_M or len(points) >= MOST_POINTS:
            points = [*points[:-1], newest._replace(speed_mps=last.speed_mps)]
        else:
            points = [*points, newest._replace(speed_mps=math.copysign(last.speed_mps, step[0]))]
        poses, speeds, ids, in_keyframe = zip(*points, strict=True)
        route = Route(
            self.name,
            np.array(poses),
            np.array(speeds),
            np.array(ids, np.int64),
            np.array(in_keyframe),
            {id: keyframe.stamp_ns for id, keyframe in keyframes.items()},
            created_s,
            map_name,
        )
        return replace(route, poses=route.in_map(keyframes))


def repeated_paths(
    route: Route, keyframes: Mapping[int, KeyframePose], pose: Array, *, loops: int, reverse: bool
) -> list[DrivePath]:
    """Return the paths that repeat a route from the nearest point on it to a pose (3,) of the base in the map.

    A closed route is driven in rounds, any other there and back, `loops` times in all. Raise OmnidError where the robot
    is not near the route, or at the end of a route that is driven once.
    """
    directed = route.reversed() if reverse else route
    poses = directed.in_map(keyframes)
    # 1. The point of entry, by position and heading; a robot beside the route drives to it first.
    away_m = np.hypot(*(poses[:, :2] - pose[:2]).T)
    if away_m.min() > ENTRY_M:
        raise OmnidError(
            f"the robot is {away_m.min():.1f} m away from the route: drive it there, to within {ENTRY_M:g} m, "
            "anywhere on it"
        )
    first = _nearest(directed, poses, pose, away_m)
    if loops == 1 and ways_m(poses[first:])[-1] <= BESIDE_M:
        raise OmnidError("the robot is at the end of the route: repeat it in reverse, or drive to its start first")
    # 2. The rest of the round, and the others.
    paths = [_path(directed, poses, first, pose if away_m[first] > BESIDE_M else None)]
    if loops > 1:
        rounds = [directed] if route.is_closed else [directed, directed.reversed()]
        whole = [_path(each, each.in_map(keyframes), 0) for each in rounds]
        paths += [whole[k % len(whole)] for k in range(1, loops)]
    return paths


def _nearest(route: Route, poses: Array, pose: Array, away_m: Array) -> int:
    """Return the nearest point of a route by place and heading; at the end of a closed one, a new round begins."""
    cost = away_m + ENTRY_M_PER_RAD * np.abs(wrapped(poses[:, 2] - pose[2]))
    near = away_m <= ENTRY_M
    if route.is_closed:
        ways = ways_m(poses)
        before_end = near & (ways < ways[-1] - CLOSED_M)
        near = before_end if before_end.any() else near
    return int(np.argmin(np.where(near, cost, np.inf)))


def _path(route: Route, poses: Array, first: int, pose: Array | None = None) -> DrivePath:
    """Return the path from a point of the route on, from the pose of a robot beside it if one is given."""
    first = min(first, len(poses) - 2)
    xy, speeds = poses[first:, :2], route.speeds[first:]
    speeds = np.where(speeds < 0, -1, 1) * np.maximum(np.abs(speeds), LEAST_MPS)
    if pose is not None:
        xy, speeds = np.vstack([pose[None, :2], xy]), np.append(speeds[:1], speeds)
        speeds[:2] = np.abs(speeds[:2])
    return drive_path(xy, float(poses[-1, 2]), speeds=speeds)
