"""Tracks of moving obstacles: clusters of the ring that stand where the ring was free before, filtered in odom.

Association to the nearest predicted track within a gate; a Kalman filter of constant velocity each (Bar-Shalom, Li,
Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", 6.3).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.kalman_filter import kalman_filter
from omnid.core.mapping.range_scan import SECTORS, RangeScan, azimuths
from omnid.core.obstacles.moving_obstacle import MovingObstacle

Array = NDArray[np.float64]

MOST_TRACKS: Final = 16
SAME_SURFACE_M: Final = 0.15  # step in range between neighbouring sectors of one cluster, beside the noise
NOISE_SIGMAS: Final = 4.0
SECTOR_GAP: Final = 2  # sectors without range within a cluster
WIDEST_M: Final = 1.2  # of a cluster that may be a person or a cart
LEAST_SECTORS: Final = 3
FARTHEST_M: Final = 4.0  # beyond it, stereo's noise looks like motion
BEFORE_NS: Final = (300_000_000, 1_600_000_000)  # age of the rings that a cluster is compared with
FREE_BEHIND_M: Final = 0.25  # an older ring saw so far behind the place of a cluster, beside the noise, or farther
FREE_SHARE: Final = 0.6  # of the points of a cluster
GATE_M: Final = 0.7  # between a cluster and a track's prediction
ACCELERATION_PSD: Final = 0.2  # (m/s^2)^2/Hz of a person
SIGMA_M: Final = 0.08  # of a cluster's middle, beside the noise of its ranges: its visible side changes
START_MPS: Final = 1.0  # sigma of the velocity of a new track
LEAST_MPS: Final = 0.2  # of a moving obstacle
SPEED_SIGMAS: Final = 1.5  # by which its speed is more than noise
CONFIRMED: Final = 2  # rings that have seen it where it was free before
FORGOTTEN_S: Final = 0.9  # without a cluster


@dataclass(frozen=True, slots=True, eq=False)
class _Cluster:
    """Neighbouring sectors of one surface."""

    middle: Array  # (2,) m in odom
    radius_m: float
    sigma_m: float
    appeared: bool  # where the ring was free before


class _Track:
    def __init__(self, stamp_ns: int, cluster: _Cluster) -> None:
        self.stamp_ns = self.seen_ns = stamp_ns
        self.appearances, self.radius_m = int(cluster.appeared), cluster.radius_m
        self._filter = kalman_filter(dim_x=4, dim_z=2)
        self._filter.H = np.eye(2, 4)
        self._filter.x = np.concatenate([cluster.middle, [0.0, 0.0]])[:, None]
        noise = SIGMA_M**2 + cluster.sigma_m**2
        self._filter.P = np.diag([noise, noise, START_MPS**2, START_MPS**2])

    @property
    def place(self) -> Array:
        return np.array(self._filter.x[:2, 0])

    def predict(self, stamp_ns: int) -> None:
        dt_s = (stamp_ns - self.stamp_ns) * 1e-9
        self.stamp_ns = stamp_ns
        F = np.eye(4)
        F[:2, 2:] = dt_s * np.eye(2)
        Q = ACCELERATION_PSD * np.kron([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]], np.eye(2))
        self._filter.predict(F=F, Q=Q)

    def update(self, cluster: _Cluster) -> None:
        self._filter.update(cluster.middle[:, None], R=(SIGMA_M**2 + cluster.sigma_m**2) * np.eye(2))
        self.seen_ns, self.radius_m = self.stamp_ns, 0.7 * self.radius_m + 0.3 * cluster.radius_m
        # What stands still for a while is where it was before, and no longer counts as moving.
        self.appearances = min(self.appearances + 1, 5) if cluster.appeared else max(self.appearances - 1, 0)

    def obstacle(self) -> MovingObstacle | None:
        """Return the moving obstacle, None where it is none."""
        x, y, vx, vy = self._filter.x[:, 0].tolist()
        P = (self._filter.P + self._filter.P.T) / 2
        speed_mps, sigma_mps = math.hypot(vx, vy), math.sqrt(max(P[2, 2], P[3, 3]))
        if self.appearances < CONFIRMED or speed_mps < max(LEAST_MPS, SPEED_SIGMAS * sigma_mps):
            return None
        return MovingObstacle(x, y, vx, vy, P, self.radius_m)


class MovingTracker:
    """Moving obstacles of the rings of a drive; all memory is bounded."""

    def __init__(self) -> None:
        self._rings: deque[tuple[int, Array, RangeScan]] = deque(maxlen=16)
        self._tracks: list[_Track] = []
        self._directions = np.column_stack([np.cos(azimuths()), np.sin(azimuths())])

    def clear(self) -> None:
        """Forget everything: odom has lost its relation to the past."""
        self._rings.clear()
        self._tracks.clear()

    def update(
        self, stamp_ns: int, T_odom_base: Array, ranges_m: RangeScan, sigma_m: RangeScan
    ) -> tuple[MovingObstacle, ...]:
        """Return the moving obstacles after a pair, of which the ring's ranges and their sigmas are given."""
        # 1. Predict the tracks.
        for track in self._tracks:
            track.predict(stamp_ns)
        # 2. Give each cluster to the nearest track within the gate, or begin one.
        waiting = list(self._tracks)
        for cluster in self._clusters(stamp_ns, T_odom_base, ranges_m, sigma_m):
            distances = [float(np.linalg.norm(track.place - cluster.middle)) for track in waiting]
            if distances and min(distances) <= GATE_M:
                waiting.pop(int(np.argmin(distances))).update(cluster)
            elif cluster.appeared and len(self._tracks) < MOST_TRACKS:
                self._tracks.append(_Track(stamp_ns, cluster))
        # 3. Forget what was long not seen.
        self._tracks = [track for track in self._tracks if (stamp_ns - track.seen_ns) * 1e-9 <= FORGOTTEN_S]
        self._rings.append((stamp_ns, T_odom_base, ranges_m))
        return tuple(found for track in self._tracks if (found := track.obstacle()) is not None)

    def _clusters(self, stamp_ns: int, T_odom_base: Array, ranges_m: RangeScan, sigma_m: RangeScan) -> list[_Cluster]:
        """Return the clusters that are narrow enough, those that appeared first."""
        near = np.isfinite(ranges_m) & (ranges_m < FARTHEST_M)
        found = []
        for sectors in surfaces(np.where(near, ranges_m, np.nan), sigma_m):
            at = ranges_m[sectors, None] * self._directions[sectors]
            width_m = float(np.linalg.norm(at[-1] - at[0]))
            if len(sectors) < LEAST_SECTORS or width_m > WIDEST_M:
                continue
            xy = at @ T_odom_base[:2, :2].T + T_odom_base[:2, 3]
            sigma = float(np.nanmedian(sigma_m[sectors])) if np.isfinite(sigma_m[sectors]).any() else SIGMA_M
            appeared = self._was_free(stamp_ns, xy, FREE_BEHIND_M + NOISE_SIGMAS * sigma)
            found.append(_Cluster(xy.mean(axis=0), max(0.15, width_m / 2), sigma, appeared))
        return sorted(found, key=lambda cluster: not cluster.appeared)

    def _was_free(self, stamp_ns: int, xy: Array, behind_m: float) -> bool:
        """True if older rings saw through the place of most points (N, 2), at least so far behind it."""
        free = np.zeros(len(xy), bool)
        for past_ns, T_odom_base, ranges_m in self._rings:
            if not BEFORE_NS[0] <= stamp_ns - past_ns <= BEFORE_NS[1]:
                continue
            at = (xy - T_odom_base[:2, 3]) @ T_odom_base[:2, :2]
            turned = (np.arctan2(at[:, 1], at[:, 0]) + math.pi) * (SECTORS / math.tau)
            sector = np.floor(turned).astype(np.intp) % SECTORS
            distance = np.hypot(at[:, 0], at[:, 1])
            with np.errstate(invalid="ignore"):
                free |= ranges_m[sector] > distance + behind_m
        return bool(free.mean() >= FREE_SHARE)


def surfaces(ranges_m: RangeScan, sigma_m: RangeScan) -> list[NDArray[np.intp]]:
    """Return the sectors of each surface of a ring, in order around the turn; NaN: none."""
    known = np.flatnonzero(np.isfinite(ranges_m))
    if not len(known):
        return []
    following = np.roll(known, -1)
    gap = (following - known) % SECTORS
    largest = SAME_SURFACE_M + NOISE_SIGMAS * np.nan_to_num(sigma_m[known])
    joined = (gap <= SECTOR_GAP + 1) & (np.abs(ranges_m[following] - ranges_m[known]) <= largest)
    ends = np.flatnonzero(~joined)
    if not len(ends):
        return [known]
    turned = np.roll(known, -(ends[0] + 1))
    cuts = (ends - ends[0])[1:]
    return np.split(turned, cuts)
