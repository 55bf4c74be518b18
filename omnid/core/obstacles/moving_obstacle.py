"""A moving obstacle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class MovingObstacle:
    """Position and velocity of an obstacle that moves, in odom."""

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    covariance: NDArray[np.float64]  # (4, 4) of x, y, vx, vy
    radius_m: float
