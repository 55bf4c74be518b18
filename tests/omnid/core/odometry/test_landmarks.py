"""The store of landmarks: positions relative to keyframes, observations, bounds."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.corners import corners
from omnid.core.odometry.landmarks import Keyframe, LandmarkStore
from omnid.core.stereo.triangulation import point_covariance, triangulate, view
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel
from tests.omnid.core.scenery import texture, wrapped

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


def add(store: LandmarkStore, seen_in: Keyframe, seen: Array) -> None:
    """Add landmarks on upright surfaces."""
    store.add_keyframe(seen_in, seen, np.zeros((len(seen), 2)))


@pytest.fixture
def store() -> LandmarkStore:
    return LandmarkStore(MODEL, max_keyframes=3, max_misses=2)


def test_points_are_kept_relative_to_their_keyframe_and_in_odom(store: LandmarkStore) -> None:
    seen = views(50)
    add(store, keyframe(1), seen)
    points = triangulate(seen, MODEL.cylinder, MODEL.baseline_m)
    covariance = point_covariance(points, MODEL.cylinder, MODEL.baseline_m, MODEL.sigma_px)
    table, R = store.table, POSE[:3, :3]
    np.testing.assert_array_equal(table.anchor_points, points)
    np.testing.assert_array_equal(table.anchor_covariance, covariance)
    np.testing.assert_allclose(table.points, se3.apply(POSE, points), rtol=1e-12)
    np.testing.assert_allclose(table.covariance, R @ covariance @ R.T, rtol=1e-9, atol=1e-18)
    assert len(store) == len(seen) > 40


def test_views_that_cannot_be_triangulated_are_left_out(store: LandmarkStore) -> None:
    seen = views(20)
    seen[3, 2] = np.nan
    seen[5, 2] = seen[5, 1] - 2
    add(store, keyframe(1), seen)
    np.testing.assert_array_equal(store.table.views, np.delete(seen, [3, 5], axis=0))
    np.testing.assert_array_equal(store.observations.views, store.table.views)


def test_disparities_of_later_frames_correct_the_depths_of_their_landmarks(store: LandmarkStore) -> None:
    """Depths that are wrong by two sigma come right with the frames, and their covariance says so."""
    truth = views(60)
    wrong = truth + np.array([0.0, 0.0, 0.4])
    noise = np.zeros((len(truth), 3, 3))
    noise[:, 2, 2] = 0.3**2
    add(store, keyframe(1), views(30, seed=1))
    store.add_keyframe(keyframe(2), wrong, np.zeros((len(truth), 2)), noise)
    rows = np.flatnonzero(store.table.anchor == 2)
    before = store.table
    T_odom_rect = POSE @ se3.exp([0.1, -0.05, 0.01, 0, 0, 0.3])
    points = se3.apply(POSE, triangulate(truth, MODEL.cylinder, MODEL.baseline_m))
    seen = view(se3.apply(se3.inverse(T_odom_rect), points), MODEL.cylinder, MODEL.baseline_m)
    disparity = seen[:, 2] - seen[:, 1]
    disparity[0] = np.nan  # not measured
    disparity[1] += 5.0  # an outlier
    for _ in range(40):
        store.update_depths(rows, disparity, np.full(len(rows), 0.3**2), T_odom_rect)
    error = [np.linalg.norm(table.points[rows] - points, axis=1) for table in (before, store.table)]
    assert (error[1][2:] < 0.25 * error[0][2:]).all()
    np.testing.assert_allclose(store.table.points[rows[:2]], before.points[rows[:2]], atol=1e-12)
    spread = [np.trace(table.covariance[rows], axis1=1, axis2=2) for table in (before, store.table)]
    assert (spread[1][2:] < 0.3 * spread[0][2:]).all()
    others = before.anchor == 1
    np.testing.assert_array_equal(store.table.points[others], before.points[others])


def test_all_observations_of_a_landmark_are_kept_by_keyframe(store: LandmarkStore) -> None:
    seen = views(30)
    add(store, keyframe(1), seen)
    ids = store.table.id[:10]
    add(store, keyframe(2), views(20, seed=1))
    later = seen[:10] + np.array([1.0, 0.5, 0.5])
    store.add_observations(2, ids, later)
    observations = store.observations
    of_first = observations.landmark == ids[0]
    np.testing.assert_array_equal(observations.keyframe[of_first], [1, 2])
    np.testing.assert_array_equal(observations.views[of_first], [seen[0], later[0]])
    assert len(observations.landmark) == len(store) + 10
    assert len(set(store.table.id)) == len(store)


def test_observations_of_removed_landmarks_or_keyframes_are_ignored(store: LandmarkStore) -> None:
    add(store, keyframe(1), views(30))
    store.add_observations(1, np.array([1000]), np.zeros((1, 3)))
    store.add_observations(9, store.table.id[:1], np.zeros((1, 3)))
    assert len(store.observations.landmark) == len(store)


def test_the_oldest_keyframe_leaves_with_its_landmarks_and_observations(store: LandmarkStore) -> None:
    each = len(views(30))
    for seq in range(10):
        known = store.table.id
        add(store, keyframe(seq), views(30))
        store.add_observations(seq, known, np.zeros((len(known), 3)))
        assert len(store.keyframes) <= 3
        assert len(store) <= 3 * each and len(store.observations.landmark) <= 3 * len(store)
    assert sorted(store.keyframes) == [7, 8, 9]
    assert set(store.table.anchor) == set(store.observations.keyframe) == {7, 8, 9}
    assert set(store.observations.landmark) == set(store.table.id)
    assert len(store.observations.landmark) == each * (3 + 2 + 1)
    assert store.anchor_shares(np.arange(len(store))) == pytest.approx({7: 1 / 3, 8: 1 / 3, 9: 1 / 3})


def test_landmarks_missed_in_several_consecutive_frames_are_removed(store: LandmarkStore) -> None:
    add(store, keyframe(1), views(30))
    before = store.table
    for rows in (np.arange(10), np.arange(5, 15)):
        store.update_tracked(rows, before.views[rows, :2])
    np.testing.assert_array_equal(store.table.points, before.points[:15])
    np.testing.assert_array_equal(store.observations.landmark, before.id[:15])
    assert np.isnan(store.table.pixels[:5]).all() and np.isfinite(store.table.pixels[5:]).all()
    for _ in range(2):
        store.update_tracked(np.arange(0), np.zeros((0, 2)))
    assert len(store) == 0 and not store.keyframes and not len(store.observations.landmark)


def test_clearing_removes_everything_and_ids_are_not_used_again(store: LandmarkStore) -> None:
    add(store, keyframe(1), views(30))
    last = store.table.id[-1]
    store.clear()
    assert len(store) == 0 and not store.keyframes and not len(store.observations.landmark)
    add(store, keyframe(2), views(30))
    assert store.table.id[0] == last + 1
