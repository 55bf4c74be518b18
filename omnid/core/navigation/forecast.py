"""Predicted occupancy: where moving obstacles will be when the base could be there.

Each keeps its velocity (van den Berg, Lin, Manocha 2008, "Reciprocal velocity obstacles", ICRA: the obstacle's
constant velocity is the usual assumption over some seconds).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles.moving_tracker import MovingObstacle

Array = NDArray[np.float64]

STEP_S: Final = 0.2  # of a prediction: a person at 1.5 m/s moves 0.3 m in it
HORIZON_S: Final = 4.0
LARGEST_SIGMA_M: Final = 0.15  # Most uncertainty of a prediction that is kept free: beyond it nothing would be free.
OWN_POINTS_M: Final = 0.25  # beyond its radius, points of the ring are its own
TRAIL_S: Final = 0.5  # The ring shows a moving obstacle where it was for this time, because pairs vote.
MEETING_S: Final = 0.6  # by which both may be early or late; by trial on development seeds
# 30 degrees apart, enough: a radius of 0.3 m errs by 1 cm between two.
CIRCLE: Final = np.array([(math.cos(a), math.sin(a)) for a in np.arange(12) * math.pi / 6])


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

    def meetings(self, position: Array, speed_mps: float) -> Array:
        """Return points (N, 2) on the discs where they will be when a base at a position (2,) can be there, too.

        A base that drives ahead at speed_mps is at a distance d after d / speed_mps, give or take MEETING_S.
        """
        t_s = np.arange(0.0, HORIZON_S, STEP_S)
        places, radius_m = self.at(t_s)
        away_m = np.linalg.norm(places - position, axis=2)
        meets = np.abs(np.maximum(away_m - radius_m, 0.0) / speed_mps - t_s) <= MEETING_S
        circles = places[:, :, None] + radius_m[..., None, None] * CIRCLE
        return np.asarray(np.vstack([circles[meets].reshape(-1, 2), places[meets]]))


def forecast(moving: Iterable[MovingObstacle], age_s: float) -> Forecast | None:
    """Return the forecast from moving obstacles that were seen some time ago; None without any."""
    found = list(moving)
    if not found:
        return None
    state = np.array([(each.x_m, each.y_m, each.vx_mps, each.vy_mps) for each in found])
    radius_m, covariance = np.array([each.radius_m for each in found]), np.array([each.covariance for each in found])
    return Forecast(state[:, :2], state[:, 2:], radius_m, covariance, age_s)
