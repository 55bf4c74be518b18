"""Depths of frames whose cameras are exposed one after the other: corrected when their velocity is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.exposure_times import AssumedMotion, Exposure, RigVelocity
from omnid.core.odometry.landmarks import LandmarkStore
from omnid.core.odometry.late_depths import LateDepths
from omnid.core.odometry.new_landmarks import NewLandmarks
from omnid.core.stereo.triangulation import triangulate, view
from omnid.core.types.pixel_times import PixelTimes
from tests.omnid.core.odometry.test_landmarks import MODEL, POSE, keyframe, views

Array = NDArray[np.float64]

TIMES = PixelTimes(0.015)
HEAVE = np.array([0.0, 0.0, 0.02, 0.0, 0.0, 0.0])  # m/s: 0.3 mm of 200 mm in 15 ms
TRUE = RigVelocity(np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.3]), 1e-6 * np.eye(6))
WRONG = RigVelocity(TRUE.twist + HEAVE, 4e-4 * np.eye(6))


def corrected(exact: Array) -> tuple[Array, Exposure]:
    """Views (N, 3) of exact ones, exposed in the true motion and corrected for the wrong one."""
    points = triangulate(exact, MODEL.cylinder, MODEL.baseline_m)
    assumed = Exposure(TIMES, WRONG, MODEL)
    shift, believed = Exposure(TIMES, TRUE, MODEL).shift(points), assumed.shift(points)
    found = exact.copy()
    found[:, 2] += believed.upper[:, 1] - shift.upper[:, 1]
    return found, assumed


def with_keyframe(exact: Array) -> tuple[LandmarkStore, LateDepths]:
    """A store with a keyframe whose views were corrected for the wrong velocity."""
    store = LandmarkStore(MODEL)
    late, (found, exposure) = LateDepths(store), corrected(exact)
    assumed = AssumedMotion(WRONG, exposure.derivatives(found))
    new = NewLandmarks(exact[:, :2], found, np.zeros((len(exact), 2)), np.zeros((len(exact), 3, 3)), assumed)
    late.added(store.add_keyframe(keyframe(1), new.views, new.slopes, new.whole_noise, new.pixels), new)
    return store, late


def scale_error(store: LandmarkStore, exact: Array) -> float:
    """Median error of the distances from the axis, as a ratio."""
    truth = triangulate(exact, MODEL.cylinder, MODEL.baseline_m)
    found = np.hypot(*store.table.anchor_points[:, :2].T) / np.hypot(*truth[:, :2].T)
    return float(np.median(found) - 1)


def test_a_new_keyframe_gets_the_scale_of_the_velocity_that_the_next_frame_shows() -> None:
    exact = views(60)
    store, late = with_keyframe(exact)
    assert abs(scale_error(store, exact)) > 1e-3, "heave looks like another baseline"
    before = store.table
    late.settle(TRUE)
    assert abs(scale_error(store, exact)) < 2e-5
    np.testing.assert_allclose(store.table.points, se3.apply(POSE, store.table.anchor_points), rtol=1e-12)
    spread = [np.trace(table.covariance, axis1=1, axis2=2) for table in (before, store.table)]
    assert (spread[1] < spread[0]).all()
    later = store.table
    late.settle(WRONG)
    assert store.table is later, "a frame is settled once"


def test_without_a_better_velocity_the_keyframe_stays_as_it_is() -> None:
    store, late = with_keyframe(views(60))
    before = store.table
    late.settle(None)
    assert store.table is before


@pytest.mark.parametrize(("velocity", "error"), [(TRUE, 2e-5), (None, 4e-4)])
def test_later_disparities_wait_for_their_velocity(velocity: RigVelocity | None, error: float) -> None:
    exact = views(60)
    store, late = with_keyframe(exact)
    late.settle(TRUE)
    T_odom_rect = POSE @ se3.exp([0.05, 0.01, 0, 0, 0, 0.02])
    points = se3.apply(se3.inverse(T_odom_rect), store.table.points)
    seen, exposure = corrected(view(points, MODEL.cylinder, MODEL.baseline_m))
    J = exposure.derivatives(seen)
    estimate = PoseEstimate(
        T_odom_rect,
        np.eye(6),
        60,
        60,
        60,
        np.arange(len(store)),
        seen,
        seen[:, :2],
        np.full(len(seen), 1e-6),
        assumed=AssumedMotion(WRONG, J[:, 2] - J[:, 1]),
    )
    before = store.table
    late.seen(store.table.id, estimate)
    assert store.table is before
    # A landmark that has left in the meantime is not mistaken for another one.
    store.update_tracked(np.arange(1, len(store)), seen[1:, :2])
    for _ in range(2):
        store.update_tracked(np.arange(1, len(store)), seen[1:, :2])
    assert len(store) == len(exact) - 1
    late.settle(velocity)
    found = abs(scale_error(store, exact[1:]))
    assert found < error if velocity else found > 1e-5


def test_disparities_of_an_instant_correct_the_map_at_once() -> None:
    exact = views(60)
    store, late = with_keyframe(exact)
    late.clear()
    seen = view(
        se3.apply(se3.inverse(POSE), se3.apply(POSE, triangulate(exact, MODEL.cylinder, MODEL.baseline_m))),
        MODEL.cylinder,
        MODEL.baseline_m,
    )
    estimate = PoseEstimate(
        POSE, np.eye(6), 60, 60, 60, np.arange(len(store)), seen, seen[:, :2], np.full(len(seen), 1e-6)
    )
    before = abs(scale_error(store, exact))
    late.seen(store.table.id, estimate)
    assert abs(scale_error(store, exact)) < 0.9 * before
    at_once = store.table
    late.settle(TRUE)
    assert store.table is at_once
