"""Tracks of moving obstacles: clusters of the scan where it was free before, filtered in odom.

Association to the most likely track within a gate of its innovation; a Kalman filter of constant velocity each
(Bar-Shalom, Li, Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", 3.6 and 6.3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from omnid.core.mapping.range_scan import SECTORS, RangeScan, azimuths

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


class Arrivals(NamedTuple):
    """Ranges from the viewpoint of what has come onto floor that was free, by one pair."""

    ranges_m: RangeScan  # (SECTORS,) of its front, NaN where nothing has come
    sigma_m: RangeScan  # (SECTORS,)
    is_nearer: Flags  # (SECTORS,) the nearest floor in view is hidden: the range is the most that it may be


@dataclass(frozen=True, slots=True, eq=False)
class MovingObstacle:
    """Position and velocity of an obstacle that moves, in odom."""

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    covariance: NDArray[np.float64]  # (4, 4) of x, y, vx, vy
    radius_m: float


SAME_SURFACE_M: Final = 0.15  # step in range between sectors of one cluster without noise
# Sigmas of a range, so that 0.5 % of the steps within a surface are larger: 2.8 of a difference.
NOISE_SIGMAS: Final = 4.0
SECTOR_GAP: Final = 2  # sectors without range within a cluster
WIDEST_M: Final = 1.2  # width of the widest cluster that may be a person or a cart
FARTHEST_M: Final = 4.0  # Farther clusters are ignored because stereo's noise there appears as motion.
# Most squared Mahalanobis distance of a cluster from a track, because 99.9 % are below it (chi-squared, 2 dimensions).
GATE: Final = 13.8
ACCELERATION_PSD: Final = 0.2  # (m/s^2)^2/Hz of a person
SIGMA_M: Final = 0.06  # least sigma of a cluster's middle, because its visible side changes
PERSON_M: Final = 0.4  # width of a person, because the rest of a narrower cluster may be on either side
START_MPS: Final = 1.0  # sigma of the velocity of a new track
LEAST_MPS: Final = 0.2  # least speed of a moving obstacle
SPEED_SIGMAS: Final = 1.5  # least speed of a moving obstacle in sigmas of that speed
# Pairs after which an object is new no longer: until then it counts as moving at any speed, as it was not there before.
NEW_UPDATES: Final = 3
FORGOTTEN_S: Final = 0.9  # A track without a cluster ends after this time.


class Cluster(NamedTuple):
    """Neighbouring sectors of one surface."""

    middle: Array  # (2,) m in odom
    covariance: Array  # (2, 2) of it
    radius_m: float


class Track:
    """A Kalman filter of constant velocity of one object."""

    def __init__(self, stamp_ns: int, cluster: Cluster) -> None:
        self.seen_ns, self.updates, self.radius_m = stamp_ns, 1, cluster.radius_m
        self.filter = KalmanFilter(dim_x=4, dim_z=2)
        self.filter.H = np.eye(2, 4)
        self.filter.x = np.concatenate([cluster.middle, [0.0, 0.0]])[:, None]
        self.filter.P = START_MPS**2 * np.eye(4)
        self.filter.P[:2, :2] = cluster.covariance

    def obstacle(self) -> MovingObstacle | None:
        """Return the track as a moving obstacle; None where it does not move, or one pair, maybe noise, has seen it."""
        x, y, vx, vy = self.filter.x[:, 0].tolist()
        P = (self.filter.P + self.filter.P.T) / 2
        least_mps = max(LEAST_MPS, SPEED_SIGMAS * math.sqrt(max(P[2, 2], P[3, 3])))
        is_at_rest = self.updates > NEW_UPDATES and math.hypot(vx, vy) < least_mps
        if self.updates == 1 or is_at_rest:
            return None
        return MovingObstacle(x, y, vx, vy, P, self.radius_m)


class MovingTracker:
    """Moving obstacles of the scans of a drive."""

    def __init__(self) -> None:
        self._tracks: list[Track] = []
        self._stamp_ns = 0

    def update(self, stamp_ns: int, T_odom_eye: Array, arrivals: Arrivals) -> tuple[MovingObstacle, ...]:
        """Return the moving obstacles after a pair, by what has come onto free floor about the viewpoint.

        T_odom_eye (4, 4): pose of the viewpoint, with the axes of the base.
        """
        # 1. Predict the tracks.
        dt_s, self._stamp_ns = (stamp_ns - self._stamp_ns) * 1e-9, stamp_ns
        one_axis = ACCELERATION_PSD * np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]])
        F, Q = np.kron([[1.0, dt_s], [0.0, 1.0]], np.eye(2)), np.kron(one_axis, np.eye(2))
        # 2. The cost of a pair of track and cluster is -2 log of its likelihood without constants, `v S^-1 v + log |S|`
        #    of the innovation v, within the gate of the first part.
        found, pairs = clusters(T_odom_eye, arrivals), []
        for track in self._tracks:
            track.filter.predict(F=F, Q=Q)
            for cluster in found:
                S, v = track.filter.P[:2, :2] + cluster.covariance, cluster.middle - track.filter.x[:2, 0]
                distance2 = float(v @ np.linalg.solve(S, v))
                if distance2 <= GATE:
                    pairs.append((distance2 + math.log(np.linalg.det(S)), track, cluster))
        # 3. The likeliest of all pairs first; clusters without a track begin one.
        begun = {id(cluster): cluster for cluster in found}
        for _, track, cluster in sorted(pairs, key=lambda pair: pair[0]):
            if track.seen_ns < stamp_ns and id(cluster) in begun:
                del begun[id(cluster)]
                track.filter.update(cluster.middle[:, None], R=cluster.covariance)
                track.radius_m = 0.7 * track.radius_m + 0.3 * cluster.radius_m
                track.seen_ns, track.updates = stamp_ns, track.updates + 1
        self._tracks += [Track(stamp_ns, cluster) for cluster in begun.values()]
        # 4. Forget what was long not seen.
        self._tracks = [track for track in self._tracks if (stamp_ns - track.seen_ns) * 1e-9 <= FORGOTTEN_S]
        return tuple(one for track in self._tracks if (one := track.obstacle()) is not None)


def clusters(T_odom_eye: Array, arrivals: Arrivals) -> list[Cluster]:
    """Return the clusters of what has come that are narrow enough."""
    arrived_m, sigma_m = arrivals.ranges_m, arrivals.sigma_m
    is_near = np.isfinite(arrived_m) & (arrived_m < FARTHEST_M)
    near_m, near_sigma_m = arrived_m[is_near], np.nan_to_num(sigma_m[is_near])
    is_last = np.abs(np.roll(near_m, -1) - near_m) > SAME_SURFACE_M + NOISE_SIGMAS * near_sigma_m
    found = []
    for sectors in runs(is_near, SECTOR_GAP, is_last):
        # What hides the nearest floor in view is anywhere before it: as near as a person is who fills that angle.
        most_m = PERSON_M * SECTORS / (math.tau * len(sectors))
        share = np.where(arrivals.is_nearer[sectors], np.minimum(most_m / arrived_m[sectors], 1.0), 1.0)
        azimuth = azimuths()[sectors]
        at = (share * arrived_m[sectors])[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth)])
        width_m = float(np.linalg.norm(at[-1] - at[0]))
        if width_m > WIDEST_M:
            continue
        away = T_odom_eye[:2, :2] @ at.mean(axis=0)
        along = away / np.linalg.norm(away)
        along2 = SIGMA_M**2 + float(((share * sigma_m[sectors]) ** 2).mean())
        # Of a person who comes out of a hidden area only a part hides floor that was free.
        across2 = SIGMA_M**2 + (max(PERSON_M - width_m, 0.0) / 2) ** 2
        covariance = across2 * np.eye(2) + (along2 - across2) * np.outer(along, along)
        found.append(Cluster(away + T_odom_eye[:2, 3], covariance, max(0.15, width_m / 2)))
    return found


def runs(flags: Flags, gap: int = 0, is_last: Flags | None = None) -> list[NDArray[np.intp]]:
    """Return the runs of directions (D,) of a turn that are set, in order around it, with gaps of so many others.

    is_last: those of the directions that are set at which a run ends, however near the next one is; None: none.
    """
    found = np.flatnonzero(flags)
    if not len(found):
        return []
    is_end = (np.roll(found, -1) - found) % len(flags) > gap + 1
    ends = np.flatnonzero(is_end if is_last is None else is_end | is_last)
    return np.split(np.roll(found, -(ends[0] + 1)), (ends - ends[0])[1:]) if len(ends) else [found]
