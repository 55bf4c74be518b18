"""The landmarks about the robot: where they are, which are seen again, and that they stay few."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.corners import corners
from omnid.core.odometry.landmarks import Keyframe, LocalMap
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.odometry.tracking import KltSettings, PaddedPanorama
from omnid.core.stereo.triangulation import point_covariance, triangulate
from tests.omnid.core.scenery import texture, turned, wrapped

Array = NDArray[np.float64]

MODEL = StereoModel(Cylinder(480, 120, 60.0), 0.2)
POSE = se3.exp([1.0, -2.0, 0.1, 0.02, 0.03, 0.7])


def keyframe(seq: int, T: Array = POSE, image: PaddedPanorama | None = None) -> Keyframe:
    return Keyframe(seq, image or wrapped(texture(1)), T, 1e-6 * np.eye(6))


def views(count: int, seed: int = 0) -> Array:
    """Corners (N, 3) of the first texture, 1 to 3 m away."""
    rng = np.random.default_rng(seed)
    usable = np.zeros((120, 480), bool)
    usable[20:100] = True
    points = corners(wrapped(texture(1)), usable, count)
    return np.column_stack([points, points[:, 1] + MODEL.cylinder.focal_px * 0.2 / rng.uniform(1, 3, len(points))])


def add(landmarks: LocalMap, seen_in: Keyframe, seen: Array) -> None:
    """Adds landmarks on upright surfaces."""
    landmarks.add(seen_in, seen, np.zeros((len(seen), 2)))


@pytest.fixture
def landmarks() -> LocalMap:
    return LocalMap(MODEL, KltSettings(), max_keyframes=3, max_misses=2)


def test_landmarks_stand_in_odom_with_their_covariance(landmarks: LocalMap) -> None:
    seen = views(50)
    add(landmarks, keyframe(1), seen)
    points = triangulate(seen, MODEL.cylinder, MODEL.baseline_m)
    np.testing.assert_allclose(landmarks.points, se3.apply(POSE, points))
    covariance = point_covariance(points, MODEL.cylinder, MODEL.baseline_m, MODEL.sigma_px)
    np.testing.assert_allclose(landmarks.covariance, POSE[:3, :3] @ covariance @ POSE[:3, :3].T)
    assert len(landmarks) == len(seen) > 40


def test_what_cannot_be_triangulated_is_left_out(landmarks: LocalMap) -> None:
    seen = views(20)
    seen[3, 2] = np.nan
    seen[5, 2] = seen[5, 1] - 2
    add(landmarks, keyframe(1), seen)
    assert len(landmarks) == len(seen) - 2
    np.testing.assert_array_equal(landmarks.views, np.delete(seen, [3, 5], axis=0))


def test_they_are_found_where_the_guess_predicts_them(landmarks: LocalMap) -> None:
    add(landmarks, keyframe(1), views(60))
    turn = 150 * 2 * np.pi / 480
    after = wrapped(turned(texture(1), 150))
    T_turned = POSE @ se3.exp([0, 0, 0, 0, 0, turn])
    tracks = landmarks.track(after, T_turned)
    assert tracks.visible == len(landmarks)
    assert len(tracks.index) > 0.95 * len(landmarks)
    expected = landmarks.views[tracks.index, :2] + (150, 0)
    assert np.abs(MODEL.cylinder.wrap(tracks.pixels[:, 0] - expected[:, 0])).max() < 0.1
    assert np.abs(MODEL.cylinder.wrap(tracks.predicted[:, 0] - expected[:, 0])).max() < 1e-6
    assert len(landmarks.track(after, POSE).index) < 0.2 * len(landmarks)


def test_patches_are_aligned_to_hundredths_where_the_pose_is_known(landmarks: LocalMap) -> None:
    add(landmarks, keyframe(1), views(60))
    turn = 150 * 2 * np.pi / 480
    T_turned = POSE @ se3.exp([0, 0, 0, 0, 0, turn])
    pixels, fitted = landmarks.align(wrapped(turned(texture(1), 150.4)), T_turned, np.arange(len(landmarks)))
    assert fitted.mean() > 0.95
    error = pixels[fitted] - landmarks.views[fitted, :2] - (150.4, 0)
    assert np.abs(MODEL.cylinder.wrap(error[:, 0])).max() < 0.05 and np.abs(error[:, 1]).max() < 0.05
    _, fitted = landmarks.align(wrapped(turned(texture(1), 155)), T_turned, np.arange(len(landmarks)))
    assert fitted.mean() < 0.2


def test_each_is_looked_for_in_its_own_keyframe(landmarks: LocalMap) -> None:
    """Two keyframes at one pose, whose images have nothing in common."""
    other = wrapped(texture(2))
    add(landmarks, keyframe(1), views(40))
    usable = np.ones((120, 480), bool)
    usable[:20] = usable[100:] = False
    points = corners(other, usable, 40)
    add(landmarks, keyframe(2, image=other), np.column_stack([points, points[:, 1] + 8]))
    for image, seq in ((wrapped(texture(1)), 1), (other, 2)):
        shown = landmarks.views.copy()
        pixels, fitted = landmarks.align(image, POSE, np.arange(len(landmarks)))
        close = fitted & (np.abs(pixels - shown[:, :2]).max(axis=1) < 0.1)
        assert landmarks.anchor_shares(np.flatnonzero(close))[seq] > 0.8
        assert close.sum() > 30


def test_keyframes_are_bounded_and_the_oldest_goes_with_its_landmarks(landmarks: LocalMap) -> None:
    for seq in range(10):
        add(landmarks, keyframe(seq), views(30))
        assert len(landmarks.keyframes) <= 3
    assert sorted(landmarks.keyframes) == [7, 8, 9]
    assert set(landmarks.anchor) == {7, 8, 9}
    parts = landmarks.points, landmarks.covariance, landmarks.views, landmarks.slopes, landmarks.anchor
    assert {len(part) for part in parts} == {3 * len(views(30))}
    assert landmarks.anchor_shares(np.arange(len(landmarks))) == pytest.approx({7: 1 / 3, 8: 1 / 3, 9: 1 / 3})


def see(landmarks: LocalMap, index: NDArray[np.intp]) -> None:
    landmarks.saw(wrapped(texture(1)), index, landmarks.views[index, :2])


def test_only_what_was_seen_last_is_tracked(landmarks: LocalMap) -> None:
    add(landmarks, keyframe(1), views(30))
    see(landmarks, np.arange(10))
    assert set(landmarks.track(wrapped(texture(1)), POSE).index) <= set(range(10))
    assert len(landmarks.track(wrapped(texture(1)), POSE).index) > 5


def test_what_is_missed_several_times_running_is_forgotten(landmarks: LocalMap) -> None:
    add(landmarks, keyframe(1), views(30))
    positions = landmarks.points.copy()
    see(landmarks, np.arange(10))
    see(landmarks, np.arange(5, 15))
    np.testing.assert_array_equal(landmarks.points, positions[:15])
    for _ in range(2):
        see(landmarks, np.arange(0))
    assert len(landmarks) == 0 and not landmarks.keyframes


def test_clearing_forgets_all_and_an_empty_map_sees_nothing(landmarks: LocalMap) -> None:
    add(landmarks, keyframe(1), views(30))
    landmarks.clear()
    assert len(landmarks) == 0 and not landmarks.keyframes
    tracks = landmarks.track(wrapped(texture(1)), POSE)
    assert tracks.visible == 0 and tracks.pixels.shape == (0, 2)
    assert landmarks.anchor_shares(tracks.index) == {}
