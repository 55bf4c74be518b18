"""Corrections of a map: what a few loops that err together are allowed to change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.core.places.correction import MapCorrection
from omnid.core.places.place_map import Link, PlaceMap
from tests.omnid.formats.place_maps import some_places

BY_ODOMETRY = np.diag([3e-4] * 3 + [1e-4] * 3) ** 2  # of each keyframe more than of the one before
BY_LOOP = np.diag([0.01] * 3 + [0.004] * 3) ** 2
ERRORS = [
    np.array([0.03, 0.03, -0.03, 0.011, 0.01, 0.0]),
    np.array([-0.03, -0.02, 0.03, -0.011, -0.009, 0.0]),
    np.array([0.02, 0.03, -0.03, 0.011, 0.01, 0.0]),
]


def driven(count: int = 12) -> PlaceMap:
    """A map of one session whose odometry is exact."""
    places = some_places(count, features=4)
    places.links = []
    for id in range(count):
        places.keyframes[id] = replace(
            places.keyframes[id], session=0, T_odom_rect=places.poses[id], covariance=(id + 1) * BY_ODOMETRY
        )
        if id:
            places.links.append(Link(id - 1, id, se3.inverse(places.poses[id - 1]) @ places.poses[id], BY_ODOMETRY))
    return places


@pytest.mark.parametrize("apart", [0, 1])
def test_loops_between_the_same_keyframes_count_as_one(apart: int) -> None:
    """Three that contradict each other say little of the drift; of different keyframes they would say more."""
    places = driven()
    before, correction = places.poses[11].copy(), MapCorrection(places)
    loops = []
    for n, error in enumerate(ERRORS):
        a, b = n * apart, 11 - n * apart
        true = se3.inverse(places.poses[a]) @ places.poses[b]
        loops.append(Link(a, b, true @ se3.exp(error), BY_LOOP, 25))
    correction.close(loops, sorted(places.keyframes))
    moved_m = float(np.linalg.norm((places.poses[11] - before)[:3, 3]))
    assert correction.optimisations == 1
    if apart:
        assert correction.factor > 20
    else:
        assert correction.factor == 1.0 and moved_m < 0.003
