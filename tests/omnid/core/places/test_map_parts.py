"""Parts of a map that are joined: which of them moves."""

from __future__ import annotations

import numpy as np

from calib import se3
from omnid.core.places.map_parts import MapParts
from omnid.core.places.place_map import PlaceMap
from tests.omnid.core.places.test_place_map import keyframe


def map_of(count: int) -> PlaceMap:
    places = PlaceMap()
    for id in range(count):
        places.add(keyframe(id), se3.exp([float(id), 0, 0, 0, 0, 0]), None)
    return places


def test_the_newer_part_moves_when_two_are_joined() -> None:
    places = map_of(2)
    parts = MapParts(places)
    places.add(keyframe(2), se3.exp([5.0, 0, 0, 0, 0, 0]), None)
    parts.add(2)
    T_old_new = se3.exp([1.0, 2.0, 0.0, 0.0, 0.0, 0.5])
    before = places.poses[2].copy()
    parts.join(0, T_old_new)
    assert (parts.current, len(parts), parts.others(), parts.ids()) == (0, 1, [], [0, 1, 2])
    np.testing.assert_allclose(places.poses[2], T_old_new @ before)
    np.testing.assert_allclose(places.poses[1][:3, 3], [1.0, 0.0, 0.0])


def test_the_older_part_stays_where_it_is_although_it_is_joined_from_a_newer_one() -> None:
    places = map_of(1)
    parts = MapParts(places)
    parts.begin()
    assert parts.current == 1
    places.add(keyframe(1), np.eye(4), None)
    parts.add(1)
    parts.begin()
    places.add(keyframe(2), np.eye(4), None)
    parts.add(2)
    parts.join(1, se3.exp([0.0, 3.0, 0.0, 0.0, 0.0, 0.0]))
    assert parts.current == 1 and parts.ids() == [1, 2] and parts.others() == [0]
    np.testing.assert_allclose(places.poses[2][:3, 3], [0.0, 3.0, 0.0])
