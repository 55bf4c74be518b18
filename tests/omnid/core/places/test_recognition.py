"""A place is recognised at any heading and in another light, with an honest covariance, and no other one is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.local_map import Keyframe
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.features import describe, describe_patches, thumbnail
from omnid.core.places.place_map import PlaceKeyframe, PlaceMap
from omnid.core.places.recognition import Expected, PlaceSearch, Relocaliser, recognise
from tests.omnid.core.scenery import RenderedCameras, motion_errors, texture, wrapped
from tests.simulation import corridor
from tests.simulation.builders import twin_corridor
from tests.simulation.paths import planar_poses

YAWS = np.array([0.0, 2.5, -1.0])
POSES = planar_poses(np.array([[0.0, 0], [0.3, 0.2], [-0.25, -0.2]]), YAWS)


@pytest.fixture(scope="module")
def frames(cameras: RenderedCameras) -> list[StereoFrame]:
    return [cameras.frame(10 + k, T) for k, T in enumerate(POSES)]


@pytest.fixture(scope="module")
def elsewhere(cameras: RenderedCameras) -> StereoFrame:
    return replace(cameras, scene=corridor(7)).frame(3, POSES[0])


# Features and thumbnails.


def test_another_light_changes_nothing_and_another_patch_much() -> None:
    image, pixels = texture(1), np.array([[60.0, 50], [150, 60], [240, 70], [330, 55], [2, 60]])
    plain, dimmer = (
        describe_patches(wrapped(of), pixels, np.full(5, 32.0)).astype(float)
        for of in (image, (0.6 * image + 30).astype(np.uint8))
    )
    apart = np.linalg.norm(plain[:, None] - dimmer[None], axis=2)
    assert np.diag(apart).max() < 60 and apart[~np.eye(5, dtype=bool)].min() > 150


# One keyframe.
@pytest.mark.parametrize("other", [1, 2])
def test_a_place_is_recognised_from_the_side_and_turned(
    cameras: RenderedCameras, frames: list[StereoFrame], other: int
) -> None:
    there, here = describe(frames[0]), describe(frames[other])
    found = recognise(here, there, 7, float(YAWS[other]), cameras.model)
    assert found is not None and found.id == 7 and found.inliers >= 20 and found.sectors >= 4
    distance, angle = motion_errors(found.T_place_rect, se3.inverse(POSES[0]) @ POSES[other])
    sigmas = np.sqrt(np.diag(found.covariance))
    assert distance < 0.02 and angle < 0.01
    assert distance < 4 * np.linalg.norm(sigmas[:3]) and angle < 4 * np.linalg.norm(sigmas[3:])
    assert sigmas.max() < 0.02


# Places that look the same: none is chosen, unless odometry decides which one it is.
PERIOD_M = 6.0
X = np.array([0.6, 0.9, 1.2])  # of the keyframes in one half of the corridor
QUERY = planar_poses(np.array([[1.0, 0.05]]), np.array([2.0]))[0]


@pytest.fixture(scope="module")
def twins(cameras: RenderedCameras) -> RenderedCameras:
    return replace(cameras, scene=twin_corridor(2, PERIOD_M))


@pytest.fixture(scope="module")
def query(twins: RenderedCameras) -> StereoFrame:
    return twins.frame(50, QUERY)


@pytest.fixture(scope="module")
def places(twins: RenderedCameras) -> PlaceMap:
    """Keyframes in both halves; the poses are those of the world."""
    places, x = PlaceMap(), np.concatenate([X, X + PERIOD_M])
    scan, free_m = np.full(360, np.nan, np.float16), np.zeros(360, np.float16)
    for id, T in enumerate(planar_poses(np.column_stack([x, 0 * x]), 0 * x)):
        frame = twins.frame(id, T)
        small, features = thumbnail(frame.lower), describe(frame)
        places.add(PlaceKeyframe(id, 0, id, T, np.eye(6), small, scan, free_m, features), T)
    return places


def test_of_two_equal_places_none_is_recognised(twins: RenderedCameras, places: PlaceMap, query: StereoFrame) -> None:
    search, small = PlaceSearch(twins.model), thumbnail(query.lower)
    assert search.find(small, describe(query), places, list(places.keyframes)) is None
    alone = search.find(small, describe(query), places, [0, 1, 2])
    assert alone is not None
    assert motion_errors(places.poses[alone.id] @ alone.T_place_rect, QUERY)[0] < 0.02


@pytest.mark.parametrize("half", [0, 1])
def test_odometry_decides_which_of_two_equal_places_is_recognised(
    twins: RenderedCameras, places: PlaceMap, query: StereoFrame, half: int
) -> None:
    """None is recognised if odometry excludes all places that look like this one."""
    search, small = PlaceSearch(twins.model), thumbnail(query.lower)
    there = se3.exp([half * PERIOD_M, 0, 0, 0, 0, 0]) @ QUERY
    expected = Expected(there, dict.fromkeys(places.keyframes, 3.0), False)
    found = search.find(small, describe(query), places, expected)
    assert found is not None and found.id // len(X) == half
    assert motion_errors(places.poses[found.id] @ found.T_place_rect, there)[0] < 0.02
    beside = replace(expected, T_map_rect=se3.exp([half * PERIOD_M, 0.6, 0, 0, 0, 0]) @ QUERY)
    assert search.find(small, describe(query), places, beside) is None


# The odometry's own keyframes, after a loss.
T_ODOM_KEYFRAME = se3.exp([3.0, 1.0, 0, 0, 0, 2.0])


def _add(relocaliser: Relocaliser, frame: StereoFrame, T_odom_rect: NDArray[np.float64]) -> None:
    relocaliser.add(frame, Keyframe(frame.seq, frame.lower, T_odom_rect, np.diag([1e-3] * 6)))


def test_the_pose_next_to_a_keyframe_is_found_and_no_pose_at_another_place(
    cameras: RenderedCameras, frames: list[StereoFrame], elsewhere: StereoFrame
) -> None:
    relocaliser = Relocaliser(cameras.model)
    assert relocaliser.locate(frames[0]) is None
    _add(relocaliser, frames[0], T_ODOM_KEYFRAME)
    estimate = relocaliser.locate(frames[2])
    assert estimate is not None and 12 <= estimate.inliers <= estimate.tracked
    distance, angle = motion_errors(estimate.T_odom_rect, T_ODOM_KEYFRAME @ se3.inverse(POSES[0]) @ POSES[2])
    sigmas = np.sqrt(np.diag(estimate.covariance))
    assert distance < 0.02 and angle < 0.01 and sigmas.max() < 0.02
    assert distance < 4 * np.linalg.norm(sigmas[:3])
    assert relocaliser.locate(elsewhere) is None and relocaliser.locate(cameras.darkness(4)) is None
    # Of two keyframes that look the same none is chosen.
    _add(relocaliser, replace(frames[0], seq=99), se3.exp([10.0, 0, 0, 0, 0, 0]))
    assert relocaliser.locate(frames[2]) is None
    relocaliser.clear()
    assert relocaliser.locate(frames[0]) is None


def test_the_newest_keyframes_are_kept_up_to_the_bound(cameras: RenderedCameras, frames: list[StereoFrame]) -> None:
    """Blank keyframes push the good one out; one near the last keyframe replaces it."""
    relocaliser = Relocaliser(cameras.model)
    _add(relocaliser, frames[0], T_ODOM_KEYFRAME)
    for k in range(7):
        _add(relocaliser, cameras.darkness(20 + k), se3.exp([10.0 + k, 0, 0, 0, 0, 0]))
        _add(relocaliser, cameras.darkness(30 + k), se3.exp([10.1 + k, 0, 0, 0, 0, 0]))
    assert relocaliser.locate(frames[2]) is not None
    _add(relocaliser, cameras.darkness(40), se3.exp([20.0, 0, 0, 0, 0, 0]))
    assert relocaliser.locate(frames[2]) is None
