"""The map of places stays within its bounds, and dropping a keyframe keeps what is linked through it."""

from __future__ import annotations

import numpy as np

from calib import se3
from omnid.core.places.place_map import KeyframeUse, Link, PlaceFeatures, PlaceKeyframe, PlaceMap


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


def test_a_dropped_keyframe_leaves_its_links_to_its_neighbours() -> None:
    places = chain(5)
    places.links.append(link(0, 2, inliers=30))
    places.drop(2)
    assert sorted((one.a, one.b) for one in places.links) == [(0, 1), (0, 3), (1, 3), (3, 4)]
    for one in places.links:
        np.testing.assert_allclose(one.T_a_b, se3.inverse(pose(one.a)) @ pose(one.b), atol=1e-12)
    loop = next(one for one in places.links if one.is_loop)
    assert (loop.a, loop.b, loop.inliers) == (0, 3, 30)
    assert np.trace(loop.covariance) > 2 * np.trace(1e-4 * np.eye(6))


def test_the_newest_keyframe_may_be_dropped_and_the_path_goes_on_from_the_one_before() -> None:
    places = chain(4)
    places.drop(0)
    assert [(one.a, one.b) for one in places.links] == [(1, 2), (2, 3)] and list(places.keyframes) == [1, 2, 3]


def test_a_full_map_drops_what_others_are_nearest_to() -> None:
    places = PlaceMap(max_keyframes=4)
    for number, x in enumerate((0.0, 1.0, 1.1, 2.0, 3.0)):
        places.add(keyframe(number), pose(x))
    assert list(places.keyframes) == [0, 2, 3, 4] and set(places.poses) == set(places.keyframes)


def test_the_memory_of_a_map_is_that_of_its_keyframes() -> None:
    places = chain(6, max_keyframes=3)
    assert len(places) == 3 and places.nbytes == 3 * keyframe(0).nbytes > 3 * 10 * 140 and places.dropped == 3


def test_edges_turned_round_and_joined_keep_their_uncertainty() -> None:
    """Sampled: the covariance of a joined edge is that of the composed motions."""
    rng = np.random.default_rng(0)
    first = Link(0, 1, se3.exp([1, 2, 0, 0, 0, 0.7]), np.diag([1e-4, 4e-4, 1e-4, 1e-6, 1e-6, 4e-6]))
    second = Link(1, 2, se3.exp([2, -1, 0.1, 0, 0, -0.4]), np.diag([4e-4, 1e-4, 1e-4, 4e-6, 1e-6, 1e-6]))
    noise = [rng.multivariate_normal(np.zeros(6), one.covariance, 20_000) for one in (first, second)]
    moved = first.T_a_b @ se3.exp(noise[0]) @ second.T_a_b @ se3.exp(noise[1])
    joined = first.then(second)
    np.testing.assert_allclose(np.cov(se3.log(se3.inverse(joined.T_a_b) @ moved).T), joined.covariance, atol=3e-5)
    back = first.reversed()
    turned = se3.inverse(first.T_a_b @ se3.exp(noise[0]))
    np.testing.assert_allclose(np.cov(se3.log(se3.inverse(back.T_a_b) @ turned).T), back.covariance, atol=2e-5)
    assert (back.a, back.b) == (1, 0)


def test_a_full_map_keeps_what_was_recognised_more_often() -> None:
    places = PlaceMap(max_keyframes=4)
    for number, x in enumerate((0.0, 1.0, 1.1, 2.0)):
        places.add(keyframe(number), pose(x))
    places.uses = {1: KeyframeUse(2, 0), 2: KeyframeUse(3, 2), 3: KeyframeUse(0, 5)}
    places.add(keyframe(4), pose(3.0))
    assert list(places.keyframes) == [0, 1, 3, 4] and set(places.uses) == {1, 3}
