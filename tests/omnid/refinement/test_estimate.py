"""Estimate of a rig's errors from a window of keyframes."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from calib.fit.drive.observations import DriveObservations, DriveState, KeyframeMotion, project
from omnid.refinement.estimate import RefinementRequest, estimate
from omnid.simulation.rendering.rigs import make_rig
from tests.simulation.paths import loop


@pytest.mark.parametrize("offset_ms", [0.0, 7.0])
def test_a_late_upper_camera_is_found_where_there_is_one(offset_ms: float) -> None:
    """Exact landmarks of a drive with turns, with noise; stamps 5 ms apart, exposures by the offset more."""
    truth, rng, keyframes, landmarks = make_rig(size=512, baseline_m=0.22), np.random.default_rng(4), 14, 140
    T_rig_odom = se3.inverse(se3.inverse(loop(4, keyframes)[0]) @ loop(4, keyframes))
    azimuth, range_m = rng.uniform(-np.pi, np.pi, landmarks), rng.uniform(1.6, 4.0, landmarks)
    points = np.column_stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), rng.uniform(-1, 1.2, landmarks)])
    keyframe, landmark, camera = (part.ravel() for part in np.mgrid[:keyframes, :landmarks, :2])
    twist = np.column_stack(
        [rng.uniform(-0.6, 0.6, (keyframes, 2)), np.zeros((keyframes, 3)), rng.uniform(-0.7, 0.7, keyframes)]
    )
    late = se3.exp(-(5e-3 + 1e-3 * offset_ms) * twist) @ T_rig_odom
    in_rig = np.where(
        camera[:, None] == 1,
        se3.apply(late, points)[keyframe, landmark],
        se3.apply(T_rig_odom, points)[keyframe, landmark],
    )
    pixels = project(truth, camera, in_rig) + 0.05 * rng.standard_normal((len(keyframe), 2))
    seen = np.isfinite(pixels).all(axis=1)
    state = DriveState(T_rig_odom, points, np.zeros(0), KeyframeMotion(twist, np.full(keyframes, 5e-3)))
    observations = DriveObservations(keyframe[seen], landmark[seen], camera[seen], pixels[seen])
    change = estimate(RefinementRequest(truth, state, observations, has_delay=True))
    assert change.delay_ms is not None and not change.has_moved
    before, after, sigma = change.delay_ms
    assert before == 0 and abs(after - offset_ms) < max(5 * sigma, 0.1) and 0 < sigma < 0.2
    assert change.has_delay is change.is_significant is (offset_ms > 0)
    assert change.rig.times.upper_delay_s == pytest.approx(1e-3 * offset_ms, abs=3e-4 if offset_ms else 0.0)
    assert change.rig.lower == truth.lower, "the geometry stays where only the delay has changed"
    assert estimate(RefinementRequest(truth, state, observations)).delay_ms is None
