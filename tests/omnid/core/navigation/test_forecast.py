"""Predicted occupancy: what moves is in the way where the base could meet it, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.navigation.forecast import LARGEST_SIGMA_M, Forecast, forecast
from omnid.core.obstacles.moving_tracker import MovingObstacle

RADIUS_M = 0.2
MEASURED = np.diag([4e-4, 4e-4, 1e-2, 1e-2])


def moving(x_m: float, y_m: float, vx_mps: float, vy_mps: float) -> Forecast:
    found = forecast([MovingObstacle(x_m, y_m, vx_mps, vy_mps, MEASURED, RADIUS_M)], 0.0)
    assert found is not None
    return found


@pytest.mark.hazard("H18")
@pytest.mark.parametrize(
    ("person", "blocks"),
    [
        ((1.6, 3.2, 0.0, -0.8), True),  # at the path when the base is
        ((3.0, 0.5, 0.0, -1.0), False),  # has passed when the base comes
        ((0.6, 3.9, 0.0, -1.0), False),  # comes when the base has passed
        ((2.0, 0.0, 0.0, 0.0), True),
        ((4.0, 0.0, -0.5, 0.0), True),
        ((-1.5, 0.0, -0.5, 0.0), False),
    ],
)
def test_the_path_is_blocked_where_the_base_meets_somebody(
    person: tuple[float, float, float, float], blocks: bool
) -> None:
    points = moving(*person).meetings(np.zeros(2), 0.4)
    ahead = points[points[:, 0] > 0.0]
    assert bool((np.abs(ahead[:, 1]) < 0.3).any()) is blocks


def test_uncertainty_makes_room_up_to_a_limit() -> None:
    _, radius_m = moving(0.0, 0.0, 0.3, 0.0).at(np.array([0.0, 1.0, 9.0]))
    assert RADIUS_M < radius_m[0, 0] < radius_m[0, 1] < radius_m[0, 2] == pytest.approx(RADIUS_M + LARGEST_SIGMA_M)
