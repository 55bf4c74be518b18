"""The map of places stays within its bounds: what leaves it, what it keeps, and which parts links join."""

from __future__ import annotations

import numpy as np

from calib import se3
from omnid.core.places.place_map import Link, PlaceFeatures, PlaceKeyframe, PlaceMap


def keyframe(number: int, features: int = 10) -> PlaceKeyframe:
    """A keyframe with random evidence."""
    return PlaceKeyframe(
        number,
        0,
        number,
        np.eye(4),
        np.eye(6),
        np.zeros((16, 128), np.int8),
        np.full(360, np.nan, np.float16),
        np.zeros(360, np.float16),
        PlaceFeatures(np.zeros((features, 128), np.uint8), np.zeros((features, 3), np.float32)),
    )


def pose(number: float) -> np.ndarray:
    """A pose on a bent path."""
    return se3.exp([number, 0.3 * number, 0, 0, 0, 0.1 * number])


def link(a: int, b: int, inliers: int = 0) -> Link:
    """The exact edge between two keyframes."""
    return Link(a, b, se3.inverse(pose(a)) @ pose(b), 1e-4 * np.eye(6), inliers)


def chain(count: int, **bounds: int) -> PlaceMap:
    """Keyframes one after the other."""
    places = PlaceMap(**bounds)
    for number in range(count):
        places.add(keyframe(number), pose(number), link(number - 1, number) if number else None)
    return places


def test_a_full_map_drops_what_others_are_nearest_to() -> None:
    places = PlaceMap(max_keyframes=4)
    for number, x in enumerate((0.0, 1.0, 1.1, 2.0, 3.0)):
        places.add(keyframe(number), pose(x))
    assert list(places.keyframes) == [0, 2, 3, 4] and set(places.poses) == set(places.keyframes)


def test_the_parts_of_a_map_are_those_that_links_join() -> None:
    places = chain(5)
    places.links = [link(0, 1), link(3, 4), link(4, 0, inliers=30)]
    assert places.parts() == [[0, 1, 3, 4], [2]]
    places.drop(4)
    assert places.parts() == [[0, 1, 3], [2]], "its links go on to its neighbour"
