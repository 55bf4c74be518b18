"""The local map: prediction, tracking and alignment of landmarks."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.corners import corners
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.plane_patches import AlignedPatches
from omnid.core.odometry.tracking import KltSettings
from omnid.core.types.panorama import PaddedPanorama
from tests.omnid.core.odometry.test_landmarks import MODEL, POSE, keyframe, views
from tests.omnid.core.scenery import texture, turned, wrapped

TURN_PX = 150
T_TURNED = POSE @ se3.exp([0, 0, 0, 0, 0, TURN_PX * 2 * np.pi / 480])


@pytest.fixture
def local_map() -> LocalMap:
    """A map with one keyframe."""
    local_map = LocalMap(MODEL, KltSettings(), max_keyframes=3, max_misses=2)
    seen = views(60)
    local_map.add_keyframe(keyframe(1), seen, np.zeros((len(seen), 2)))
    return local_map


def update_tracked(local_map: LocalMap, landmarks: NDArray[np.intp]) -> None:
    local_map.update_tracked(wrapped(texture(1)), landmarks, local_map.store.table.views[landmarks, :2])


def test_landmarks_are_tracked_from_where_the_guess_predicts_them(local_map: LocalMap) -> None:
    after = wrapped(turned(texture(1), TURN_PX))
    tracks = local_map.track(after, T_TURNED)
    assert tracks.visible == len(local_map)
    assert len(tracks.landmarks) > 0.95 * len(local_map)
    expected = local_map.store.table.views[tracks.landmarks, :2] + (TURN_PX, 0)
    assert np.abs(MODEL.cylinder.wrap(tracks.pixels[:, 0] - expected[:, 0])).max() < 0.1
    assert np.abs(MODEL.cylinder.wrap(tracks.predicted[:, 0] - expected[:, 0])).max() < 1e-6
    assert len(local_map.track(after, POSE).landmarks) < 0.2 * len(local_map)


def test_tracks_a_sample_to_compare_guesses(local_map: LocalMap) -> None:
    after = wrapped(turned(texture(1), TURN_PX))
    tracks = local_map.track(after, T_TURNED, most=20)
    assert 15 <= tracks.visible <= 20
    assert len(tracks.landmarks) > 0.9 * tracks.visible


def test_samples_of_three_turns_are_all_landmarks(local_map: LocalMap) -> None:
    after = wrapped(turned(texture(1), TURN_PX))
    samples = [local_map.track(after, T_TURNED, most=len(local_map) // 3 + 1, turn=turn) for turn in (4, 5, 6)]
    assert sum(sample.visible for sample in samples) == len(local_map)
    assert all(sample.each_counts * sample.visible == pytest.approx(len(local_map)) for sample in samples)
    assert len(np.unique(np.concatenate([sample.landmarks for sample in samples]))) > 0.95 * len(local_map)


def test_without_a_pyramid_landmarks_are_found_near_the_guess_only(local_map: LocalMap) -> None:
    after, guess = wrapped(turned(texture(1), TURN_PX + 3)), T_TURNED
    near = local_map.track(after, guess, near=True)
    assert len(near.landmarks) > 0.95 * len(local_map)
    error = near.pixels[:, 0] - local_map.store.table.views[near.landmarks, 0] - TURN_PX - 3
    assert np.abs(MODEL.cylinder.wrap(error)).max() < 0.1
    far = wrapped(turned(texture(1), TURN_PX + 12))
    assert len(local_map.track(far, guess, near=True).landmarks) < 0.5 * len(local_map.track(far, guess).landmarks)


def aligned_everywhere(local_map: LocalMap, lower: PaddedPanorama, T_odom_rect: NDArray[np.float64]) -> AlignedPatches:
    """Align the patches of all landmarks, which that pose must see."""
    landmarks, predicted = local_map.visible(T_odom_rect)
    assert len(landmarks) == len(local_map)
    return local_map.align(lower, T_odom_rect, landmarks, predicted[:, :2])


def test_patches_are_aligned_to_hundredths_of_a_pixel_where_the_pose_is_known(local_map: LocalMap) -> None:
    patches = aligned_everywhere(local_map, wrapped(turned(texture(1), TURN_PX + 0.4)), T_TURNED)
    pixels, aligned = patches.pixels, patches.found
    assert aligned.mean() > 0.95
    error = pixels[aligned] - local_map.store.table.views[aligned, :2] - (TURN_PX + 0.4, 0)
    assert np.abs(MODEL.cylinder.wrap(error[:, 0])).max() < 0.05 and np.abs(error[:, 1]).max() < 0.05
    far = aligned_everywhere(local_map, wrapped(turned(texture(1), TURN_PX + 5)), T_TURNED)
    assert far.found.mean() < 0.2


def test_each_landmark_is_aligned_with_its_own_keyframe() -> None:
    """Two keyframes at one pose, whose images have nothing in common."""
    local_map = LocalMap(MODEL, KltSettings())
    seen = views(40)
    local_map.add_keyframe(keyframe(1), seen, np.zeros((len(seen), 2)))
    other = wrapped(texture(2))
    usable = np.ones((120, 480), bool)
    usable[:20] = usable[100:] = False
    points = corners(other, usable, 40)
    seen = np.column_stack([points, points[:, 1] + 8])
    local_map.add_keyframe(keyframe(2, image=other), seen, np.zeros((len(seen), 2)))
    for image, seq in ((wrapped(texture(1)), 1), (other, 2)):
        aligned = aligned_everywhere(local_map, image, POSE)
        close = aligned.found & (np.abs(aligned.pixels - local_map.store.table.views[:, :2]).max(axis=1) < 0.1)
        assert local_map.store.anchor_shares(np.flatnonzero(close))[seq] > 0.8
        assert close.sum() > 30


def test_only_inliers_of_the_last_frame_are_tracked(local_map: LocalMap) -> None:
    update_tracked(local_map, np.arange(10))
    tracks = local_map.track(wrapped(texture(1)), POSE)
    assert set(tracks.landmarks) <= set(range(10)) and len(tracks.landmarks) > 5


def test_an_empty_map_tracks_nothing(local_map: LocalMap) -> None:
    local_map.clear()
    assert len(local_map) == 0
    tracks = local_map.track(wrapped(texture(1)), POSE)
    assert tracks.visible == 0 and tracks.pixels.shape == (0, 2)
    assert local_map.store.anchor_shares(tracks.landmarks) == {}
