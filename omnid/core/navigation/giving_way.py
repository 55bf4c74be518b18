"""Giving way: a base that is blocked drives back along the way that it came, waits there, and comes again.

Robots and people who wait for each other in a door or a corridor are distinguished from permanent obstacles by the
same rule: the base goes back once, to where others can pass, and again after twice the time, and so on. The way back
is the one that it has just driven, as far as it is seen to be free now.
"""

from __future__ import annotations

import math
from collections import deque
from enum import Enum, auto
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.navigation.follower import Follower, Following
from omnid.core.navigation.path import drive_path
from omnid.core.navigation.settings import NavigationSettings

Array = NDArray[np.float64]

SPACING_M: Final = 0.1  # Spacing of the kept places, because a path has no nearer points.
SHORTEST_M: Final = 0.3  # Least length of a way back, because a shorter one makes no room for anybody.
CLEAR_M: Final = 1.0  # Least way back to a wider place: nearer to the block the base would still be in the way.
BACK_MPS: Final = 0.2  # slower than forwards, because people do not expect a robot to back up
# Length of the way back that is free now, enough for the distance to stop and a person's two steps.
LOOK_M: Final = 1.0
# Room next to the outline in which a person passes, because shoulders have 0.6 m; the rest is a margin.
PASS_M: Final = 0.8
REST_S: Final = 3.0  # Least time before the base returns: a person needs it to go past a base.
SPREAD_S: Final = 4  # Added to it, by the stamp of the pose, so that two robots that met move at different times.
# The base returns after this time in any case, to search a way; then after twice the time.
RETRY_S: Final = 10.0
LONGEST_RETRY_S: Final = 300.0  # Twelve attempts an hour, so that a way that becomes free is found.
FREE_S: Final = 1.0  # The way ahead has been free for this time, because rings vote for half a second.
ARRIVED_M: Final = 0.1  # The way ends this far from its last point; enough: it is one spacing.
FAR_M: Final = 1e3  # Distance in directions without an obstacle: larger than any measured one.
NARROWER_M: Final = 0.005  # Least change of width between two places of the way: more than rounding.


class Trail:
    """The places where the base has just been, in odom, with the direction in which it drove."""

    def __init__(self, length_m: float) -> None:
        """length_m: that is kept."""
        self._places: deque[tuple[float, float, bool]] = deque(maxlen=max(2, math.ceil(length_m / SPACING_M) + 1))

    def restart(self) -> None:
        """Forget the places: odom has begun again."""
        self._places.clear()

    def add(self, pose: Array, speed_mps: float) -> None:
        """Add the pose (3,) of a base that drives at a speed, forwards above 0."""
        if not self._places or math.dist(pose[:2], self._places[-1][:2]) >= SPACING_M:
            self._places.append((float(pose[0]), float(pose[1]), speed_mps < 0))

    def back(self, pose: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the way back (N, 2) from a pose (3,), and which points are reached backwards (N,).

        The base came to each place from the next one of the way back: it leaves it in the opposite direction.
        """
        newest_first = list(reversed(self._places))
        xy = np.array([pose[:2], *(place[:2] for place in newest_first)], np.float64)
        came_backwards = [place[2] for place in newest_first[:1] + newest_first]
        return xy, ~np.array((came_backwards[:1] + came_backwards)[: len(xy)], bool)


class Phase(Enum):
    """Phases of giving way."""

    BACK = auto()
    REST = auto()
    RETURN = auto()


class GivingWay:
    """The way back, rests, and the way to the place where the base was blocked. All in odom."""

    def __init__(self, xy: Array, backwards: NDArray[np.bool_], settings: NavigationSettings, stamp_ns: int) -> None:
        """xy: the way back (N, 2), from the place where the base was blocked. backwards: (N,) as in `Trail.back`."""
        self._settings = settings
        self._xy, self._backwards = xy, backwards
        self._spread_s = stamp_ns // 1_000_000_000 % SPREAD_S
        self._rested_s = self._free_s = 0.0
        self._retry_s = RETRY_S
        self.phase = self._before = Phase.BACK
        self.follower = self._driving(0, len(xy) - 1)

    def drive(self, stamp_ns: int, pose: Array, speed_mps: float, yaw_rate_radps: float) -> Following | None:
        """Return the motion at a pose (3,); None at the end of the way."""
        following = self.follower.step(stamp_ns, pose, speed_mps, yaw_rate_radps)
        return None if following.done or following.left_m < ARRIVED_M else following

    def look_back(self) -> Array:
        """Return the part (N, 2) of the way back that must be free now."""
        return self.follower.path_ahead(LOOK_M)

    def rest(self) -> None:
        """Wait from now on."""
        self._before, self.phase = self.phase, Phase.REST
        self._rested_s = self._free_s = 0.0

    def way_to_block(self, pose: Array) -> Array:
        """Return the way (N, 2) from a pose (3,) to where the base was blocked."""
        return np.vstack([pose[None, :2], self._xy[: self._nearest(pose)][::-1]])

    def move_on(self, pose: Array, dt_s: float, is_open: bool) -> bool:
        """Begin to return where the way has become free, or to try once more after a while; False at the block.

        is_open: the way from the pose (3,) to the place where it was blocked, and past it, is free. A base that was
        blocked again on its return goes back again.
        """
        self._rested_s += dt_s
        self._free_s = self._free_s + dt_s if is_open else 0.0
        is_free = self._free_s >= FREE_S and self._rested_s >= REST_S + self._spread_s
        if not is_free and self._rested_s < self._retry_s:
            return True
        if not is_free:
            self._retry_s = min(2 * self._retry_s, LONGEST_RETRY_S)
        phase = Phase.RETURN if is_free or self._before is Phase.BACK else Phase.BACK
        start, end = self._nearest(pose), 0 if phase is Phase.RETURN else len(self._xy) - 1
        if start != end:
            self.phase, self.follower = phase, self._driving(start, end)
        return phase is Phase.BACK or start != end

    def _driving(self, start: int, end: int) -> Follower:
        """Return what drives from a point of the way back to another one."""
        if start < end:
            xy, backwards = self._xy[start : end + 1], self._backwards[start : end + 1]
        else:  # each point is left in the direction opposite to that in which the way back came from it
            xy = self._xy[end : start + 1][::-1]
            backwards = ~np.append(self._backwards[end + 1 : start + 1], self._backwards[start])[::-1]
        speeds = np.full(len(xy), BACK_MPS)
        return Follower(drive_path(xy, speeds=speeds, backwards=list(map(bool, backwards))), self._settings)

    def _nearest(self, pose: Array) -> int:
        """Return the point of the way back that is nearest to a pose (3,)."""
        return int(np.argmin(np.hypot(*(self._xy - pose[:2]).T)))


def give_way(
    trail: Trail, settings: NavigationSettings, pose: Array, stamp_ns: int, obstacles: Array, half_width_m: float
) -> GivingWay | None:
    """Return the way back from a pose (3,), up to where others can pass; None where there is none.

    obstacles (M, 2): in odom. half_width_m: of the room that the base needs.
    """
    xy, backwards = trail.back(pose)
    ways = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    # 1. As far as it is free now, and no farther than is wanted.
    is_closed = closed(xy, obstacles, half_width_m)
    last = int(np.argmax(is_closed)) if is_closed.any() else len(xy)
    last = min(last, int(np.searchsorted(ways, settings.give_way_m, side="right")))
    # 2. Up to the next place where others can pass.
    is_wide = (_rooms(xy[:last], obstacles) > half_width_m + PASS_M) & (ways[:last] >= CLEAR_M)
    if is_wide.any():
        last = int(np.argmax(is_wide)) + 1
    if last < 2 or ways[last - 1] < SHORTEST_M:
        return None
    return GivingWay(xy[:last], backwards[:last], settings, stamp_ns)


def closed(path: Array, obstacles: Array, half_width_m: float) -> NDArray[np.bool_]:
    """Return at which points (N,) of a way back it is too narrow and gets narrower.

    What the base drives away from, in front of it, may be nearer than its half width.
    """
    room_m = _rooms(path, obstacles)
    gets_narrower = np.diff(room_m, prepend=room_m[0]) < -NARROWER_M
    return np.asarray((room_m < half_width_m) & gets_narrower)


def is_free(path: Array, obstacles: Array, room_m: float) -> bool:
    """True if a path (N, 2) keeps a distance from all obstacles (M, 2)."""
    return bool((_rooms(path, obstacles) >= room_m).all())


def _rooms(path: Array, obstacles: Array) -> Array:
    """Return the distance of each point (N, 2) to the nearest obstacle (M, 2), FAR_M without any."""
    if not len(obstacles):
        return np.full(len(path), FAR_M)
    return np.asarray(np.hypot(path[:, None, 0] - obstacles[:, 0], path[:, None, 1] - obstacles[:, 1]).min(axis=1))
