"""Ring over time: a vote of the last pairs, and memory of what the cameras cannot see now, both in odom."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.mapping.range_scan import SECTORS, azimuths, fill_gaps
from omnid.core.obstacles.floor_view import FloorView
from omnid.core.obstacles.free_space import FreeSpace
from omnid.core.obstacles.observation import Observation
from omnid.core.obstacles.settings import RingSettings

Array = NDArray[np.float64]

PAIRS: Final = 4  # that vote
VOTE_NS: Final = 1_500_000_000  # older pairs do not vote
SAME_SECTORS: Final = 2  # difference in direction at which two ranges may be of one obstacle
SAME_M: Final = 0.12  # and difference in range, beside the noise
SAME_SIGMAS: Final = 3.0
BEHIND_M: Final = 0.1  # beyond obstacles.ring.blind_m: from here on a range shows that a nearer obstacle is gone
THICK_M: Final = 0.4  # of what hides the floor, from its foot to where stereo sees it
NEAR_NS: Final = 60_000_000_000  # for which a nearer obstacle is believed against a range that does not show that


@dataclass(frozen=True, slots=True, eq=False)
class RingPoints:
    """Obstacles of a ring as points in odom."""

    xy: Array  # (N, 2) m
    sigma_m: Array  # (N,)
    seen_ns: NDArray[np.int64]  # (N,)


class RingFilter:
    """Confirms obstacles by votes, and remembers those whose direction is unknown now.

    An obstacle that too few pairs have seen makes its direction unknown, not free, and so does what stereo does not
    see, but what hides floor that was free before. All memory is bounded: PAIRS observations, one remembered obstacle a
    sector.
    """

    def __init__(self, settings: RingSettings) -> None:
        self._settings = settings
        self._history: deque[tuple[int, RingPoints]] = deque(maxlen=PAIRS - 1)
        self._memory: RingPoints | None = None
        self._free = FreeSpace(settings.max_range_m, settings.free_s, settings.change_grey)
        self._directions = np.column_stack([np.cos(azimuths()), np.sin(azimuths())])

    def clear(self) -> None:
        """Forget everything: the pose has lost its relation to the past."""
        self._history.clear()
        self._free.clear()
        self._memory = None

    def update(self, stamp_ns: int, T_odom_base: Array, seen: Observation, view: Callable[[Array], FloorView]
               ) -> Observation:
        """Return the ring after a pair, whose base frame has the pose T_odom_base (4, 4).

        view: returns the looks of the floor at places (N, 2) [m] in the base frame.
        """
        ranges = [np.where(np.isfinite(seen.ranges_m), seen.ranges_m, np.inf).astype(float)]
        sigmas = [np.where(np.isfinite(seen.sigma_m), seen.sigma_m, 0.0).astype(float)]
        stamps = [stamp_ns]
        for past_ns, points in self._history:
            if 0 <= stamp_ns - past_ns <= VOTE_NS:
                found = self._in_base(points, T_odom_base)
                ranges.append(found[0])
                sigmas.append(found[1])
                stamps.append(past_ns)
        accepted, sigma, of = self._vote(np.array(ranges), np.array(sigmas))
        age_stamps = np.array(stamps, np.int64)[of]
        unknown = ~np.isfinite(accepted) & ~np.isposinf(seen.ranges_m)
        accepted, sigma, age_stamps = self._remembered(stamp_ns, T_odom_base, accepted, sigma, age_stamps, unknown)
        # An obstacle ends what is known to be free, one that is not confirmed as well.
        seen = seen._replace(free_m=np.minimum(seen.free_m, accepted).astype(np.float32))
        floor = self._free.update(stamp_ns, T_odom_base, seen, accepted, view)
        # What is behind something that has come is not known any more, unless it is that itself.
        accepted = np.where(floor.hidden_m + THICK_M + SAME_SIGMAS * sigma < accepted, np.inf, accepted)
        known = np.isfinite(accepted)
        is_open = np.isposinf(seen.ranges_m) & np.isposinf(floor.hidden_m)
        result = np.where(known, accepted, np.where(is_open, np.inf, np.nan)).astype(np.float32)
        free = np.minimum(floor.free_m, accepted)
        is_seen = np.isfinite(seen.ranges_m)
        self._history.append((stamp_ns, self._points(T_odom_base, np.where(is_seen, seen.ranges_m, np.nan),
                                                     sigmas[0], np.full(SECTORS, stamp_ns))))
        self._memory = self._points(T_odom_base, np.where(known, accepted, np.nan), sigma, age_stamps)
        return Observation(result, np.where(known, sigma, np.nan).astype(np.float32), free.astype(np.float32))

    def _vote(self, ranges: Array, sigmas: Array) -> tuple[Array, Array, NDArray[np.intp]]:
        """Return the nearest confirmed obstacle (SECTORS,), inf without one, its sigma, and the pair it is of."""
        votes = np.zeros(ranges.shape, np.intp)
        for voter in ranges:
            is_near = np.zeros(ranges.shape, bool)
            for shift in range(-SAME_SECTORS, SAME_SECTORS + 1):
                with np.errstate(invalid="ignore"):
                    is_near |= np.abs(np.roll(voter, shift) - ranges) <= SAME_M + SAME_SIGMAS * sigmas
            votes += is_near
        confirmed = np.where(np.isfinite(ranges) & (votes >= self._settings.min_votes), ranges, np.inf)
        of = np.argmin(confirmed, axis=0)
        at = np.arange(SECTORS)
        return confirmed[of, at], sigmas[of, at], of

    def _remembered(self, stamp_ns: int, T_odom_base: Array, accepted: Array, sigma: Array,
                    seen_ns: NDArray[np.int64], unknown: NDArray[np.bool_]
                    ) -> tuple[Array, Array, NDArray[np.int64]]:
        """Return the ring with what was there before where nothing is known now."""
        if self._memory is None or not len(self._memory.xy):
            return accepted, sigma, seen_ns
        ranges, sigmas, stamps = self._in_base(self._memory, T_odom_base)
        fresh = stamp_ns - stamps <= self._settings.memory_s * 1e9
        is_near = ranges <= self._settings.blind_m
        # What is too near for stereo is matched wrongly, a little farther away: that is no view past it.
        is_hiding = is_near & (ranges < accepted) & (accepted <= self._settings.blind_m + BEHIND_M)
        is_hiding &= stamp_ns - stamps <= NEAR_NS
        keep = np.isfinite(ranges) & (unknown & (fresh | is_near) | is_hiding)
        return (np.where(keep, ranges, accepted), np.where(keep, sigmas, sigma), np.where(keep, stamps, seen_ns))

    def _points(self, T_odom_base: Array, ranges: Array, sigma: Array, seen_ns: NDArray[np.int64]) -> RingPoints:
        known = np.flatnonzero(np.isfinite(ranges))
        at = ranges[known, None] * self._directions[known]
        xy = at @ T_odom_base[:2, :2].T + T_odom_base[:2, 3]
        return RingPoints(xy, sigma[known].astype(float), seen_ns[known])

    def _in_base(self, points: RingPoints, T_odom_base: Array) -> tuple[Array, Array, NDArray[np.int64]]:
        """Return range, sigma and stamp (SECTORS,) of the nearest of points in each direction from the base now."""
        at = (points.xy - T_odom_base[:2, 3]) @ T_odom_base[:2, :2]
        distance = np.hypot(at[:, 0], at[:, 1])
        turned = (np.arctan2(at[:, 1], at[:, 0]) + math.pi) * (SECTORS / (2 * math.pi))
        sector = np.floor(turned).astype(np.intp) % SECTORS
        order = np.argsort(-distance, kind="stable")  # the nearest is written last
        ranges, sigmas = np.full(SECTORS, np.inf), np.zeros(SECTORS)
        stamps = np.zeros(SECTORS, np.int64)
        ranges[sector[order]], sigmas[sector[order]] = distance[order], points.sigma_m[order]
        stamps[sector[order]] = points.seen_ns[order]
        # Nearer now, the points of one surface lie further apart in direction.
        filled = fill_gaps(np.where(np.isfinite(ranges), ranges, np.nan).astype(np.float32)).astype(float)
        new = np.isfinite(filled) & ~np.isfinite(ranges)
        if new.any():
            known = np.flatnonzero(np.isfinite(ranges))
            before = known[np.searchsorted(known, np.flatnonzero(new), side="right") - 1]
            ranges[new], sigmas[new], stamps[new] = filled[new], sigmas[before], stamps[before]
        return ranges, sigmas, stamps
