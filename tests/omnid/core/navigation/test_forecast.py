"""Moving obstacles on a path."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.navigation.forecast import Pace, yielding
from tests.omnid.core.navigation.test_moving_people import at


def test_a_fast_one_from_the_side_is_not_taken_for_one_from_behind() -> None:
    path = np.column_stack([np.arange(0.0, 4.0, 0.05), np.zeros(80)])
    pace = Pace(0.4, 0.4, 0.3, 0.4, 0.26)
    share, coming = yielding(path, 4.0, at(-0.5, 0.9, 2.0, -0.8), pace)
    assert share < 1.0 and not coming[0], "119 degrees from the direction of the path"
    assert yielding(path, 4.0, at(-0.57, 0.9, 2.0, -0.8), pace).share == 1.0, "122 degrees"


@pytest.mark.parametrize("seed", range(4))
def test_at_the_share_of_the_speed_the_base_meets_none_who_passes_and_a_higher_one_would(seed: int) -> None:
    """A drive in steps of a millimetre along a bent path, past discs that cross it."""
    rng, shares = np.random.default_rng(seed), []
    path = np.array([(0.05 * k, 0.0) for k in range(21)] + [(1.0 + 0.03 * k, 0.04 * k) for k in range(1, 61)])
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(path, axis=0).T)))
    pace = Pace(0.4, 0.4, 0.3, 0.4, 0.26)
    for _ in range(12):
        goal, velocity = path[rng.integers(10, 50)], rng.uniform(0.3, 0.9) * np.array([rng.choice([-1, 1]), 0.4])
        moving = at(*(goal - rng.uniform(1.0, 4.0) * velocity[::-1]), *velocity[::-1])
        share, coming = yielding(path, 9.0, moving, pace)
        if coming.any() or np.hypot(*moving.xy[0]) < 0.8:
            continue
        shares.append(share)
        for tried, meets in ((share, False), (min(share + 0.25, 1.0), share < 1.0)):
            t_s = np.arange(0.0, 4.0, 0.01)
            speeds = np.maximum(0.4 - 0.3 * t_s, tried * 0.4)
            way_m = np.cumsum(speeds) * 0.01
            base = np.column_stack([np.interp(way_m, along, path[:, axis]) for axis in range(2)])
            to = moving.xy[0] + t_s[:, None] * moving.velocity[0] - base
            is_ahead = (to * np.gradient(base, axis=0)).sum(axis=1) > 0.0
            gap_m = np.where(is_ahead, np.hypot(*to.T) - 0.2 - pace.moving_room_m, 9.0)
            assert gap_m.min() < 0.1 if meets else tried == 0.0 or gap_m.min() > -0.1, (share, tried)
    assert len(set(shares)) > 1


def test_who_stands_before_the_base_and_begins_to_walk_away_does_not_come() -> None:
    pace = Pace(0.0, 0.4, 0.3, 0.4, 0.26)
    path = np.column_stack([np.arange(0.0, 4.0, 0.05), np.zeros(80)])
    share, coming = yielding(path, 4.0, at(0.3, 0.0, 0.1, 0.0), pace)
    assert share == 0.0 and not coming[0]
