"""Moving obstacles on a path: where they will be, and how fast the path can be driven so that they have passed.

Each keeps its velocity (van den Berg, Lin, Manocha 2008, "Reciprocal velocity obstacles", ICRA: the obstacle's
constant velocity is the usual assumption over some seconds). Speeds along the path are tried from the highest one down
(Kant, Zucker 1986, "Toward efficient trajectory planning: the path-velocity decomposition", IJRR).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles.moving_tracker import MovingObstacle

Array = NDArray[np.float64]

STEP_S: Final = 0.2  # of a prediction: a person at 1.5 m/s moves 0.3 m in it
HORIZON_S: Final = 4.0
WAIT_S: Final = 10.0  # Time ahead in which an object must reach the waiting base for the base to avoid it.
SHARES: Final = np.linspace(1.0, 0.0, 5)  # Tried speeds, as shares of that on the path.
LARGEST_SIGMA_M: Final = 0.15  # Most uncertainty of a prediction that is kept free: beyond it nothing would be free.
OWN_POINTS_M: Final = 0.25  # beyond its radius, points of the ring are its own
TRAIL_S: Final = 0.5  # The ring shows a moving obstacle where it was for this time, because pairs vote.
# Times about a predicted meeting at which the disc counts as an obstacle at rest; by trial on development seeds.
MEETING_S: Final = np.array([-0.6, 0.0, 0.6])
# 30 degrees apart, enough: a radius of 0.3 m errs by 1 cm between two.
CIRCLE: Final = np.array([(math.cos(a), math.sin(a)) for a in np.arange(12) * math.pi / 6])
BEHIND_SHARE: Final = -0.5  # Cosine of the direction beyond which one is behind the base: 120 degrees.


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """Discs that move at constant velocities from a time some seconds ago, in odom."""

    xy: Array  # (K, 2) m
    velocity: Array  # (K, 2) m/s
    radius_m: Array  # (K,)
    covariance: Array  # (K, 4, 4) of x, y, vx, vy
    age_s: float

    def at(self, t_s: Array) -> tuple[Array, Array]:
        """Return places (K, T, 2) at times (T,) from now on, and their radii with one sigma (K, T)."""
        t = t_s + self.age_s
        places = self.xy[:, None] + self.velocity[:, None] * t[:, None]
        P = np.moveaxis(self.covariance, 0, 2)[..., None]  # (4, 4, K, 1)
        variance = np.maximum(*(P[k, k] + 2 * t * P[k, k + 2] + t**2 * P[k + 2, k + 2] for k in (0, 1)))
        sigma_m = np.minimum(np.sqrt(np.maximum(variance, 0.0)), LARGEST_SIGMA_M)
        return places, self.radius_m[:, None] + sigma_m

    def others(self, points: Array) -> Array:
        """Return those of the points (N, 2) of a ring that are not of these obstacles."""
        back = -TRAIL_S * self.velocity
        to = points[:, None] - self.at(np.zeros(1))[0][:, 0]
        share = np.clip((to * back).sum(axis=2) / np.maximum((back**2).sum(axis=1), 1e-9), 0.0, 1.0)
        away_m = np.linalg.norm(to - share[..., None] * back, axis=2)
        return np.asarray(points[(away_m > self.radius_m + OWN_POINTS_M).all(axis=1)])

    def outlines(self, which: NDArray[np.bool_], position: Array, speed_mps: float) -> Array:
        """Return points (N, 2) on discs (K,) where they meet a base that comes to them from a position (2,)."""
        to = self.at(np.zeros(1))[0][which, 0] - position
        velocity, away_m = self.velocity[which], np.maximum(np.hypot(to[:, 0], to[:, 1]), 1e-9)
        nearing_mps = speed_mps - (to * velocity).sum(axis=1) / away_m
        meet_s = np.where(nearing_mps * HORIZON_S > away_m, away_m / np.maximum(nearing_mps, 1e-9), HORIZON_S)
        t_s = np.maximum(meet_s[:, None] + MEETING_S, 0.0)
        places = (position + to)[:, None] + velocity[:, None] * t_s[..., None]
        circles = self.radius_m[which][:, None, None, None] * CIRCLE + places[:, :, None]
        return np.asarray(circles.reshape(-1, 2))


def forecast(moving: Iterable[MovingObstacle], age_s: float) -> Forecast | None:
    """Return the forecast from moving obstacles that were seen some time ago; None without any."""
    found = list(moving)
    if not found:
        return None
    state = np.array([(each.x_m, each.y_m, each.vx_mps, each.vy_mps) for each in found])
    radius_m, covariance = np.array([each.radius_m for each in found]), np.array([each.covariance for each in found])
    return Forecast(state[:, :2], state[:, 2:], radius_m, covariance, age_s)


@dataclass(frozen=True, slots=True)
class Pace:
    """Motion along a path: speeds in m/s, acceleration in m/s^2."""

    speed_mps: float  # now
    highest_mps: float
    acceleration_mps2: float
    moving_room_m: float  # room around the base's origin in motion
    standing_room_m: float  # room around the base's origin at rest


class Yielding(NamedTuple):
    """Speed at which what moves has passed, and what does not pass."""

    share: float  # share of the path's speed
    coming: NDArray[np.bool_]  # (K,) which of them come to where the base would wait: no speed lets them pass


def yielding(path: Array, length_m: float, moving: Forecast, pace: Pace) -> Yielding:
    """Return the largest share of the speed at which the base meets none that may pass, within HORIZON_S.

    path: (N, 2) from the base on; it is driven up to length_m.
    """
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    # 1. Who comes to the base where it is now, and is not there yet.
    waits_s = np.arange(0.0, WAIT_S, STEP_S)
    away_m = np.linalg.norm(moving.at(waits_s)[0] - path[0], axis=2)
    comes = (away_m.argmin(axis=1) > 0) & (away_m.min(axis=1) < moving.radius_m + pace.standing_room_m)
    # 2. Whom the base meets at each share of the speed.
    t_s = np.arange(0.0, HORIZON_S + STEP_S, STEP_S)
    places, radii = moving.at(t_s)
    coming = np.zeros(len(comes), bool)
    for share in SHARES.tolist():
        change_mps = pace.acceleration_mps2 * t_s
        wanted_mps = share * pace.highest_mps
        speeds = pace.speed_mps + np.clip(wanted_mps - pace.speed_mps, -change_mps, change_mps)
        ways = np.minimum(np.append(0.0, np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * STEP_S)), length_m)
        base = np.column_stack([np.interp(ways, along, path[:, axis]) for axis in range(2)])
        ahead = np.column_stack([np.interp(ways + STEP_S, along, path[:, axis]) for axis in range(2)]) - base
        to = places - base
        gap_m, forward = np.linalg.norm(to, axis=2), (to * ahead).sum(axis=2)
        room_m = np.where((speeds > 0.0) & (ways < min(length_m, along[-1])), pace.moving_room_m, pace.standing_room_m)
        # One that comes from behind sees the base, and no speed of the base would help.
        is_behind = forward[:, 0] < BEHIND_SHARE * gap_m[:, 0] * np.linalg.norm(ahead[0])
        met = ((gap_m < radii + room_m) & (forward > 0)).any(axis=1) & ~is_behind
        if share == 1.0:
            coming = met & comes
        if not (met & ~coming).any():
            return Yielding(share, coming)
    return Yielding(0.0, coming)
