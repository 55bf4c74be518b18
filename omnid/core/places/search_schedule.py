"""Schedule of the map: the frames that become keyframes, and those in which places are searched for."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.hypotheses import angle_rad, length_m
from omnid.core.places.limits import PlaceLimits
from omnid.core.places.place_map import PlaceKeyframe

Array = NDArray[np.float64]

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
