"""Where a frame may be: poses that searches have proposed and that must agree, and when a search is due."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.place_map import Link, PlaceKeyframe, PlaceLimits
from omnid.core.places.recognition import Recognition, angle_rad, length_m

Array = NDArray[np.float64]

# Set by trial on development seeds, where a line gives no other reason.
CONSISTENT: Final = 3  # recognitions that give the same pose, before they count
KEPT: Final = 6  # recognitions that are remembered
APART_M, APART_RAD = 0.05, math.radians(5)  # least motion between two frames that count as two
SAME_M, SAME_RAD = 0.12, math.radians(1.5)  # largest difference of poses that agree
SURE_INLIERS: Final = 24  # Inliers of recognitions that count without motion: a robot may be at rest.


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A recognition, and the frame it was made in."""

    recognition: Recognition
    keyframe: int  # id of the newest keyframe of the run at that time
    T_keyframe_rect: Array  # (4, 4) by odometry
    covariance: Array  # (6, 6) of T_keyframe_rect
    T_odom_rect: Array  # (4, 4)

    def T_map_rect(self, poses: Mapping[int, Array]) -> Array:
        """Return the pose of the frame in the map of these poses of keyframes."""
        return np.asarray(poses[self.recognition.id] @ self.recognition.T_place_rect)

    def T_map_odom(self, poses: Mapping[int, Array]) -> Array:
        """Return the pose of odom in the map of these poses of keyframes."""
        return np.asarray(self.T_map_rect(poses) @ se3.inverse(self.T_odom_rect))

    @property
    def is_sure(self) -> bool:
        """True if it counts without motion since the one before."""
        return self.recognition.inliers >= SURE_INLIERS

    def link(self) -> Link:
        """Return the recognition as an edge from the recognised keyframe to the newest one of the run."""
        found = Link(
            self.recognition.id,
            -1,
            self.recognition.T_place_rect,
            self.recognition.covariance,
            self.recognition.inliers,
        )
        return found.then(Link(self.keyframe, -1, self.T_keyframe_rect, self.covariance).reversed())


class Hypotheses:
    """Recognitions of the last frames."""

    def __init__(self) -> None:
        self._kept: deque[Hypothesis] = deque(maxlen=KEPT)
        self._counted: deque[Hypothesis] = deque(maxlen=KEPT)

    def __len__(self) -> int:
        return len(self._kept)

    def clear(self) -> None:
        """Forget all recognitions."""
        self._kept.clear()

    def take(self, one: Hypothesis) -> bool:
        """True the first time: a recognition counts once."""
        if any(one is counted for counted in self._counted):
            return False
        self._counted.append(one)
        return True

    def add(self, new: Hypothesis, poses: Mapping[int, Array]) -> list[Hypothesis]:
        """Add a recognition; return the consistent ones, the new one last; none if there are fewer than CONSISTENT."""
        known = [kept for kept in self._kept if kept.recognition.id in poses and kept.keyframe in poses]
        self._kept.append(new)
        distinct: list[Hypothesis] = []
        for one in (*(kept for kept in known if _consistent(kept, new, poses)), new):
            if one.is_sure or all(_apart(one, other) for other in distinct):
                distinct.append(one)
        return distinct if len(distinct) >= CONSISTENT else []


def _consistent(a: Hypothesis, b: Hypothesis, poses: Mapping[int, Array]) -> bool:
    """True if both place the newer frame at the same pose in the map."""
    difference = se3.inverse(a.T_map_odom(poses) @ b.T_odom_rect) @ b.T_map_rect(poses)
    return length_m(difference) < SAME_M and angle_rad(difference) < SAME_RAD


def _apart(a: Hypothesis, b: Hypothesis) -> bool:
    moved = se3.inverse(a.T_odom_rect) @ b.T_odom_rect
    return length_m(moved) > APART_M or angle_rad(moved) > APART_RAD


# Odometry computes dense depth at its own keyframes. Where it makes none, the map waits for this multiple of the
# distance between its keyframes before it asks for dense depth itself.
WAIT_FACTOR: Final = 2.0
# A recognition is checked in a frame that has moved by this amount; by trial on development seeds.
CHECK_M, CHECK_RAD = 0.1, math.radians(8)
SEARCH_NS: Final = 200_000_000  # At most five searches a second, so that most of the time is left to other stages.
JITTER_NS: Final = 5_000_000  # Stamps vary, so a rate that divides that of the cameras is reached with this tolerance.
# After this number of searches without success only new keyframes are searched for.
SEARCHES: Final = 10


class SearchSchedule:
    """Decides from the motion and the time since the last keyframe and the last search."""

    def __init__(self, limits: PlaceLimits) -> None:
        self._limits = limits
        self.restart()

    def restart(self) -> None:
        """Forget the last search: odometry was continued after a gap of unknown motion."""
        self._searched: tuple[int, Array] | None = None  # stamp and T_odom_rect of the last search
        self._failed = 0  # searches of this part of the map that found nothing

    def keyframe_is_due(
        self, newest: PlaceKeyframe | None, stamp_ns: int, T_odom_rect: Array, *, has_depth: bool
    ) -> bool:
        """True if the view has changed enough since the newest keyframe; sooner for a frame whose depth is known."""
        if newest is None:
            return True
        if stamp_ns - newest.stamp_ns < 1e9 / self._limits.rate_hz - JITTER_NS:
            return False
        moved = se3.inverse(newest.T_odom_rect) @ T_odom_rect
        change = max(
            length_m(moved) / self._limits.keyframe_m, angle_rad(moved) / math.radians(self._limits.keyframe_deg)
        )
        return change >= (1.0 if has_depth else WAIT_FACTOR)

    def search_is_due(self, stamp_ns: int, T_odom_rect: Array, *, is_unknown: bool, is_pending: bool) -> bool:
        """True if a frame that becomes no keyframe is to be searched for places.

        is_unknown: the pose in another part of the map is not known. is_pending: a recognition waits to be confirmed.
        """
        if self._searched is None:
            return True
        since_ns, moved = stamp_ns - self._searched[0], se3.inverse(self._searched[1]) @ T_odom_rect
        if since_ns < SEARCH_NS:
            return False
        if self._failed < SEARCHES and is_unknown:
            return True
        return is_pending and (length_m(moved) > CHECK_M or angle_rad(moved) > CHECK_RAD)

    def begin(self, stamp_ns: int, T_odom_rect: Array) -> None:
        """Note that a search begins at a frame."""
        self._searched = stamp_ns, T_odom_rect

    def end(self, *, found: bool, could_find: bool) -> None:
        """Note the result of a search. could_find: the frame had enough features, so it was not too dark to search."""
        if found:
            self._failed = 0
        elif could_find:
            self._failed += 1
