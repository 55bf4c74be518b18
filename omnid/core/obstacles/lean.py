"""Slow lean of the rig against the floor: the tilt by which the floor's plane fits the nearest floor of all pairs.

A tilt (a, b) of the floor changes the disparity of all its rows by f t / h (a cos u + b sin u), whatever their range.
So the difference of both views on the plane, by the gradient along columns, is a linear measurement of a and b, and a
Kalman filter adds up pairs. Floor without texture has no gradient, and changes nothing. Only floor nearer than where a
step down looks like a tilt counts, and only where it is known.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles.pair_views import DIRECTIONS, WorkingPair

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

PRIOR_RAD: Final = math.radians(1.0)  # sigma of a rig that leans
DRIFT_RAD: Final = math.radians(0.05)  # sigma of the change from pair to pair
BAND_ROWS: Final = 17  # rows of the mean that is subtracted
ALIKE: Final = 20.0  # pixels with one error: neighbours are smoothed, and share what is wrong
LEAST_RAD: Final = math.radians(0.15)  # change of the tilt for which the tables are made again


class Lean:
    """Tilt (2,) of the floor beyond that which the rig states, and its covariance (2, 2)."""

    def __init__(self) -> None:
        self.tilt, self._P = np.zeros(2), PRIOR_RAD**2 * np.eye(2)
        azimuth = math.pi - (np.arange(DIRECTIONS) + 0.5) * (math.tau / DIRECTIONS)
        self._way = np.column_stack([np.cos(azimuth), np.sin(azimuth)])

    @property
    def sigma(self) -> Array:
        """Standard deviations (2,) of the tilt [rad]."""
        return np.asarray(np.sqrt(np.diag(self._P)))

    def observe(self, pair: WorkingPair, plane_rows: Floats, known: Flags, px_per_rad: float, used: Array) -> None:
        """Take a pair over a plane with the tilt `used` (2,); plane_rows (H,): row of the upper view that shows a row.

        known (H, DIRECTIONS): rows of the lower one that show near floor; px_per_rad: change of the disparity by tilt.
        """
        self._P = self._P + DRIFT_RAD**2 * np.eye(2)
        rows = np.flatnonzero(known.any(axis=1))
        if not len(rows):
            return
        # 1. Difference and gradient of both views on the plane, of the rows that are needed.
        at, upto = plane_rows[rows], len(pair.upper)
        begin, end = max(int(at[0]) - BAND_ROWS, 0), min(int(at[-1]) + 2 + BAND_ROWS, upto)
        one, two = (
            image - cv2.blur(image, (1, BAND_ROWS))
            for image in (pair.lower[rows[0] : rows[-1] + 1], pair.upper[begin:end])
        )
        slope = (np.roll(two, -1, 0) - np.roll(two, 1, 0)) / 2
        above = np.minimum(np.floor(at).astype(int), upto - 2) - begin
        share = (at - np.floor(at))[:, None].astype(np.float32)
        there = two[above] * (1 - share) + two[above + 1] * share
        gradient = slope[above] * (1 - share) + slope[above + 1] * share
        difference, counts = one[rows - rows[0]] - there, known[rows]
        # 2. Normal equations of the two slopes; single pixels that differ by much count little.
        sigma = max(1.48 * float(np.median(np.abs(difference[counts]))), 0.3)
        weight = counts / (1.0 + (difference / (1.5 * sigma)) ** 2)
        squares, products = (weight * gradient * gradient).sum(0), (weight * gradient * difference).sum(0)
        # The gradient has noise of its own: without that share a plain floor would seem to measure something.
        textured = max(1.0 - float(weight.sum()) * sigma**2 / 4 / max(float(squares.sum()), 1e-6), 0.0)
        squares, products = textured * textured * squares, textured * products
        scale = px_per_rad / (sigma * math.sqrt(ALIKE))
        H = scale**2 * np.einsum("u,ui,uj->ij", squares, self._way, self._way)
        y = scale**2 / px_per_rad * (self._way.T @ products)
        # 3. The filter: information of the pair, about the tilt that its plane has.
        information = np.linalg.inv(self._P)
        self._P = np.linalg.inv(information + H)
        self.tilt = self._P @ (information @ self.tilt + H @ used + y)
