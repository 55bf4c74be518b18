"""The map of places stays within its bounds: what leaves it, what it keeps, and which parts links join."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.core.places.place_map import (
    AGED_MISSES,
    VISIT_M,
    KeyframeUse,
    Link,
    PlaceFeatures,
    PlaceKeyframe,
    PlaceMap,
)


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


def test_a_full_map_keeps_what_was_recognised_more_often() -> None:
    places = PlaceMap(max_keyframes=4)
    for number, x in enumerate((0.0, 1.0, 1.1, 2.0)):
        places.add(keyframe(number), pose(x))
    places.uses = {1: KeyframeUse(2, 0), 2: KeyframeUse(3, 2), 3: KeyframeUse(0, 5)}
    places.add(keyframe(4), pose(3.0))
    assert list(places.keyframes) == [0, 1, 3, 4] and set(places.uses) == {1, 3}


def test_the_parts_of_a_map_are_those_that_links_join() -> None:
    places = chain(5)
    places.links = [link(0, 1), link(3, 4), link(4, 0, inliers=30)]
    assert places.parts() == [[0, 1, 3, 4], [2]]
    places.drop(4)
    assert places.parts() == [[0, 1, 3], [2]], "its links go on to its neighbour"


HERE = pose(2)[:3, 3]


@pytest.mark.parametrize(
    ("visits", "use_before", "use_after"),
    [
        ([[{2: 5, 0: 80}, {2: 0, 0: 70}]] * AGED_MISSES, None, KeyframeUse(0, AGED_MISSES)),
        ([[{2: 5}]] * (AGED_MISSES + 1), None, None),
        ([[{2: 5}, {2: 60}], [{2: 5}], [{2: 3}]] * AGED_MISSES, None, KeyframeUse(AGED_MISSES, 2)),
        ([[{2: 0}]] * 10, KeyframeUse(10, 0), KeyframeUse(10, 10)),
        ([[{2: 0}]] * 11, KeyframeUse(10, 0), None),
    ],
    ids=["missed", "missed too often", "found now and then", "was found often", "as often missed"],
)
def test_a_keyframe_that_is_missed_visit_after_visit_leaves_and_its_links_stay(
    visits: list[list[dict[int, int]]], use_before: KeyframeUse | None, use_after: KeyframeUse | None
) -> None:
    """A visit has one frame or two, each with the inliers of the keyframes that it was compared with."""
    places = chain(5)
    places.uses = {2: use_before} if use_before else {}
    for number, frames in enumerate(visits):
        for frame, inliers in enumerate(frames):
            places.observe(HERE, inliers, 2 * VISIT_M * number + 0.1 * frame)
    assert places.uses.get(2) == use_after and (2 in places.keyframes) == (use_after is not None)
    assert places.aged == (use_after is None) and len(places.parts()) == 1


def test_keyframes_that_are_farther_away_are_not_missed() -> None:
    places = chain(5)
    for number in range(10):
        places.observe(HERE, {1: 0, 4: 0, 7: 0}, 2 * VISIT_M * number)
    assert places.uses == {} and len(places) == 5
