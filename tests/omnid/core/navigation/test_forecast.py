"""Moving obstacles on a path."""

from __future__ import annotations

import numpy as np

from omnid.core.navigation.forecast import Forecast, Pace, forecast, yielding
from omnid.core.obstacles.moving_obstacle import MovingObstacle
from tests.omnid.core.navigation.test_moving_people import at


def test_the_share_of_the_speed_by_hand() -> None:
    path = np.column_stack([np.arange(0.0, 4.0, 0.05), np.zeros(80)])
    pace = Pace(0.4, 0.4, 0.3, 0.4, 0.26)

    def judged(length_m: float, moving: Forecast) -> tuple[float, bool]:
        share, coming = yielding(path, length_m, moving, pace)
        return share, bool(coming[0])

    assert judged(4.0, at(3.0, 2.0, 0.0, 0.0)) == (1.0, False)
    # In 2.5 s the base is at 1 m, and the person, from 2 m aside at 0.8 m/s, there as well.
    share, coming = judged(4.0, at(1.0, 2.0, 0.0, -0.8))
    assert 0.0 <= share < 1.0 and not coming
    assert judged(0.2, at(1.0, 2.0, 0.0, -0.8)) == (1.0, False), "it turns at a corner before"
    assert judged(4.0, at(1.5, 0.0, -0.5, 0.0)) == (1.0, True), "it comes to where the base would wait"
    assert judged(4.0, at(-0.8, 0.0, 0.8, 0.0)) == (1.0, False), "it comes from behind"
    share, coming = judged(4.0, at(0.8, 0.0, 0.2, 0.0))
    assert share == 0.5 and not coming, "it walks ahead, more slowly"


def test_a_fast_one_from_the_side_is_not_taken_for_one_from_behind() -> None:
    path = np.column_stack([np.arange(0.0, 4.0, 0.05), np.zeros(80)])
    pace = Pace(0.4, 0.4, 0.3, 0.4, 0.26)
    share, coming = yielding(path, 4.0, at(-0.5, 0.9, 2.0, -0.8), pace)
    assert share < 1.0 and not coming[0], "119 degrees from the direction of the path"
    assert yielding(path, 4.0, at(-0.65, 0.9, 2.0, -0.8), pace).share == 1.0, "126 degrees"


def test_points_where_it_was_longer_ago_than_the_ring_remembers_are_of_others() -> None:
    points = np.array([(-0.9, 0.0), (-1.0, 0.0), (0.4, 0.0), (0.5, 0.0)])
    np.testing.assert_array_equal(at(0.0, 0.0, 1.0, 0.0).others(points), points[[1, 3]])


def test_an_uncertain_velocity_that_belongs_to_an_uncertain_place_makes_it_more_uncertain() -> None:
    P = np.diag([0.01, 0.01, 0.01, 0.01])
    P[0, 2] = P[2, 0] = P[1, 3] = P[3, 1] = 0.005
    found = forecast([MovingObstacle(1.0, 0.0, 0.5, 0.0, P, 0.2)], 0.4)
    assert found is not None
    np.testing.assert_allclose(found.variance, [[0.01 + 0.8 * 0.005 + 0.16 * 0.01, 0.005 + 0.4 * 0.01, 0.01]])


def test_a_forecast_goes_on_from_the_age_of_the_ring() -> None:
    one = MovingObstacle(1.0, 0.0, 0.5, 0.0, np.diag([0.01, 0.01, 0.04, 0.04]), 0.2)
    places, radii = forecast([one], 0.4).at(np.array([0.0, 1.0]))  # type: ignore[union-attr]
    np.testing.assert_allclose(places[0], [(1.2, 0.0), (1.7, 0.0)])
    np.testing.assert_allclose(radii[0], 0.2 + np.minimum(np.sqrt([0.01 + 0.04 * 0.16, 0.01 + 0.04 * 1.96]), 0.15))
    assert forecast([], 0.1) is None
