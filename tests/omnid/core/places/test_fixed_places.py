"""Keyframes that stay: the ones near a position."""

from __future__ import annotations

import numpy as np

from calib import se3
from omnid.core.places.map_parts import FixedPlaces
from tests.omnid.core.places.test_map_parts import map_of


def test_near_ones_are_found_in_their_order() -> None:
    places = map_of(10)
    places.drop(4)
    fixed = FixedPlaces(places, sorted(places.keyframes))
    assert fixed.within(np.array([4.2, 0, 0]), 1.0) == [5]
    assert fixed.within(np.array([3.0, 0, 0]), 1.0) == [2, 3]
    places.move({5: se3.exp([50.0, 0, 0, 0, 0, 0])})
    assert fixed.within(np.array([5.0, 0, 0]), 0.5) == [5] and list(fixed.scans) == fixed.ids
    assert FixedPlaces(places, []).within(np.zeros(3), 1.0) == []
