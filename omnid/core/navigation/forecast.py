"""Moving obstacles on a path: where they will be, and how fast the path can be driven so that they have passed.

Each keeps its velocity (van den Berg, Lin, Manocha 2008, "Reciprocal velocity obstacles", ICRA: the obstacle's
constant velocity is the usual assumption over some seconds). Speeds along the path are tried from the highest one down
(Kant, Zucker 1986, "Toward efficient trajectory planning: the path-velocity decomposition", IJRR).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles.moving_tracker import MovingObstacle

Array = NDArray[np.float64]

# Set by trial on development seeds, where a line gives no other reason.
HORIZON_S: Final = 4.0
WAIT_S: Final = 10.0  # Time ahead in which an object must reach the waiting base for the base to avoid it.
STEPS: Final = 20
SHARES: Final = (1.0, 0.75, 0.5, 0.25, 0.0)  # Tried speeds, as shares of that on the path.
LARGEST_SIGMA_M: Final = 0.15  # Most uncertainty of a prediction that is kept free: beyond it nothing would be free.
OWN_POINTS_M: Final = 0.25  # beyond its radius, points of the ring are its own
TRAIL_S: Final = 0.5  # The ring shows a moving obstacle where it was for this time, because pairs vote.
# Set by trial: times about a predicted meeting at which the disc counts as an obstacle at rest.
MEETING_S: Final = np.array([-0.6, 0.0, 0.6])
SLOWEST_MPS: Final = 0.1  # Lower bound of the speed of approach, so that the time until a meeting is bounded.
# 30 degrees apart, enough: a radius of 0.3 m errs by 1 cm between two.
CIRCLE: Final = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
LEAST_MPS: Final = 0.01  # A slower base counts as standing, because it needs no more room than that.
# Cosine of the direction beyond which one is behind the base; 120 degrees; by trial on development seeds.
BEHIND_SHARE: Final = -0.5


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """Discs that move at constant velocities from now on, in odom."""

    xy: Array  # (K, 2) m
    velocity: Array  # (K, 2) m/s
    radius_m: Array  # (K,)
    variance: Array  # (K, 3) of the place, of place and velocity, of the velocity; the larger ones of both axes

    def at(self, t_s: Array) -> tuple[Array, Array]:
        """Return places (K, T, 2) at times (T,), and their radii with one sigma (K, T)."""
        places = self.xy[:, None] + self.velocity[:, None] * t_s[:, None]
        of_place, shared, of_velocity = (self.variance[:, k, None] for k in range(3))
        sigma_m = np.sqrt(np.maximum(of_place + 2 * t_s * shared + t_s**2 * of_velocity, 0.0))
        return places, self.radius_m[:, None] + np.minimum(sigma_m, LARGEST_SIGMA_M)

    def others(self, points: Array) -> Array:
        """Return those of the points (N, 2) of a ring that are not of these obstacles."""
        back = -TRAIL_S * self.velocity
        to = points[:, None] - self.xy
        share = np.clip((to * back).sum(axis=2) / np.maximum((back**2).sum(axis=1), 1e-9), 0.0, 1.0)
        away_m = np.linalg.norm(to - share[..., None] * back, axis=2)
        return np.asarray(points[(away_m > self.radius_m + OWN_POINTS_M).all(axis=1)])

    def outlines(self, which: NDArray[np.bool_], position: Array, speed_mps: float) -> Array:
        """Return points (N, 2) on discs (K,) where they meet a base that comes to them from a position (2,)."""
        to, velocity = self.xy[which] - position, self.velocity[which]
        away_m = np.maximum(np.hypot(to[:, 0], to[:, 1]), 1e-9)
        nearing_mps = speed_mps - (to * velocity).sum(axis=1) / away_m
        meet_s = np.minimum(away_m / np.maximum(nearing_mps, SLOWEST_MPS), HORIZON_S)
        t_s = np.maximum(meet_s[:, None] + MEETING_S, 0.0)
        places = self.xy[which][:, None] + velocity[:, None] * t_s[..., None]
        circle = np.column_stack([np.cos(CIRCLE), np.sin(CIRCLE)])
        return np.asarray((places[:, :, None] + self.radius_m[which][:, None, None, None] * circle).reshape(-1, 2))


def forecast(moving: Iterable[MovingObstacle], age_s: float) -> Forecast | None:
    """Return the forecast from moving obstacles that were seen some time ago; None without any."""
    found = list(moving)
    if not found:
        return None
    velocity = np.array([(each.vx_mps, each.vy_mps) for each in found])
    P = np.array([each.covariance for each in found])
    of_place, shared, of_velocity = (np.maximum(P[:, a, b], P[:, a + 1, b + 1]) for a, b in ((0, 0), (0, 2), (2, 2)))
    variance = np.column_stack(
        [of_place + 2 * age_s * shared + age_s**2 * of_velocity, shared + age_s * of_velocity, of_velocity]
    )
    xy = np.array([(each.x_m, each.y_m) for each in found]) + age_s * velocity
    return Forecast(xy, velocity, np.array([each.radius_m for each in found]), variance)


@dataclass(frozen=True, slots=True)
class Pace:
    """Motion along a path: speeds in m/s, acceleration in m/s^2."""

    speed_mps: float  # now
    highest_mps: float
    acceleration_mps2: float
    moving_room_m: float  # room around the base's origin in motion
    standing_room_m: float  # room around the base's origin at rest

    def ways(self, cap_mps: float, t_s: Array) -> tuple[Array, Array]:
        """Return way and speed (T,) at equal times with a highest speed."""
        change = np.sign(cap_mps - self.speed_mps) * self.acceleration_mps2 * t_s
        speeds = np.clip(self.speed_mps + change, min(cap_mps, self.speed_mps), max(cap_mps, self.speed_mps))
        steps = 0.5 * (speeds[1:] + speeds[:-1]) * np.diff(t_s)
        return np.concatenate([[0.0], np.cumsum(steps)]), speeds


class Yielding(NamedTuple):
    """Speed at which what moves has passed, and what does not pass."""

    share: float  # share of the path's speed
    coming: NDArray[np.bool_]  # (K,) which of them come to where the base would wait: no speed lets them pass


def yielding(path: Array, length_m: float, moving: Forecast, pace: Pace) -> Yielding:
    """Return the largest share of the speed at which the base meets none that may pass, within HORIZON_S.

    path: (N, 2) from the base on; it is driven up to length_m.
    """
    steps_m = np.hypot(*np.diff(path, axis=0).T) if len(path) > 1 else np.zeros(0)
    along = np.concatenate([[0.0], np.cumsum(steps_m)])
    t_s = np.linspace(0.0, HORIZON_S, STEPS + 1)
    places, radii = moving.at(t_s)
    coming = np.zeros(len(moving.xy), bool)
    for share in SHARES:
        ways, speeds = pace.ways(share * pace.highest_mps, t_s)
        ways = np.minimum(ways, min(length_m, along[-1]))
        base = np.column_stack([np.interp(ways, along, path[:, axis]) for axis in range(2)])
        to = places - base
        moves = (speeds > LEAST_MPS) & (ways < length_m)
        room_m = np.where(moves, pace.moving_room_m, pace.standing_room_m)
        meets = np.hypot(to[..., 0], to[..., 1]) < radii + room_m
        # One that comes from behind sees the base, and no speed of the base would help.
        forward_m = (to * _direction(path, along, ways)).sum(axis=2)
        is_behind = forward_m[:, 0] < BEHIND_SHARE * np.hypot(to[:, 0, 0], to[:, 0, 1])
        met = (meets & (forward_m > 0)).any(axis=1) & ~is_behind
        if share == SHARES[0]:
            coming = met & _comes_to(moving, base[0], pace.standing_room_m)
        if not (met & ~coming).any():
            return Yielding(share, coming)
    return Yielding(0.0, coming)


def _comes_to(moving: Forecast, position: Array, room_m: float) -> NDArray[np.bool_]:
    """Return which of them come nearer to a position (2,) than the room (K,), and are not there yet."""
    to = position - moving.xy
    speed2 = np.maximum((moving.velocity**2).sum(axis=1), 1e-9)
    nearest_s = np.clip((to * moving.velocity).sum(axis=1) / speed2, 0.0, WAIT_S)
    away_m = np.linalg.norm(to - nearest_s[:, None] * moving.velocity, axis=1)
    return np.asarray((nearest_s > 0) & (away_m < moving.radius_m + room_m))


def _direction(path: Array, along: Array, ways: Array) -> Array:
    """Return the direction (T, 2) of a path at ways."""
    if len(path) < 2:
        return np.zeros((len(ways), 2))
    k = np.clip(np.searchsorted(along, ways, side="right") - 1, 0, len(path) - 2)
    d = path[k + 1] - path[k]
    return np.asarray(d / np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-9)[:, None])
