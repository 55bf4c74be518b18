"""What the covariance of a rig says of its accuracy, and the drift of a rig from rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.fit.rig_drift import CORRELATED_POINTS, estimate_rig_drift
from calib.fit.rig_uncertainty import drive_uncertainty
from calib.models.camera import Array
from calib.models.unified import UnifiedCamera
from calib.rig import Rig, RigCovariance
from tests.simulation.rigs import make_rig, with_upper_rotated


def with_sigma(rig: Rig, name: str, sigma: float) -> Rig:
    return replace(rig, covariance=RigCovariance.of_matrix((name,), np.array([[sigma**2]])))


def test_a_longer_baseline_is_a_scale_and_no_heading() -> None:
    found = drive_uncertainty(with_sigma(make_rig(baseline_m=0.2), "baseline", 0.2e-3))
    assert found is not None
    assert found.scale == pytest.approx(1e-3, rel=1e-3) and found.heading_rad_m < 1e-7


def test_a_focal_length_changes_the_scale_as_much_as_it_does_in_the_odometry() -> None:
    """One camera's focal length 0.05 % off cost 0.49 % of length on a rendered drive."""
    rig = make_rig()
    assert isinstance(rig.lower.camera, UnifiedCamera)
    covariance = np.array([[1.0, -1.0], [-1.0, 1.0]]) * (5e-4 * rig.lower.camera.focal[1]) ** 2
    found = drive_uncertainty(replace(rig, covariance=RigCovariance.of_matrix(("lower fu", "lower fv"), covariance)))
    assert found is not None
    assert found.scale == pytest.approx(0.0049, rel=0.25)
    assert str(found).startswith("scale uncertain by 0.") and str(found).endswith("degree/m (one sigma)")
    assert drive_uncertainty(rig) is None


# Drift of a rig from rays


def rays(rig: Rig, points: Array, assumed: Rig) -> tuple[Array, Array]:
    """Return the true rig's rays to points (rig frame), in the rectified frame of an assumed rig."""
    found = []
    for true, wrong in ((rig.lower, assumed.lower), (rig.upper, assumed.upper)):
        seen = se3.apply(true.T_cam_rig, points)
        found.append(seen @ wrong.T_cam_rig[:3, :3] @ assumed.T_rect_rig[:3, :3].T)
    return found[0], found[1]


@pytest.mark.parametrize("turn_deg", [(-3.0, 2.0, 5.0), (0, 0, 0)])
def test_a_rotation_about_every_axis_is_estimated_and_corrected(
    rig: Rig, around: Array, turn_deg: tuple[float, float, float]
) -> None:
    wrong = with_upper_rotated(rig, turn_deg)
    drift = estimate_rig_drift(*rays(rig, around, wrong))
    assert drift is not None
    assert np.rad2deg(drift.turn) == pytest.approx(turn_deg, abs=1e-5)
    assert np.abs(drift.shift).max() < 1e-6 and np.abs(drift.residuals).max() < 1e-7
    again = wrong.with_upper_moved(drift.turn, drift.shift)
    np.testing.assert_allclose(again.upper.T_cam_rig, rig.upper.T_cam_rig, atol=1e-6)
    assert again.lower is wrong.lower and again.topics == rig.topics


def test_a_shifted_viewpoint_is_distinguished_from_a_tilt(rig: Rig, around: Array) -> None:
    R = rig.T_rect_rig[:3, :3]
    T_rig_upper = se3.inverse(rig.upper.T_cam_rig)
    T_rig_upper[:3, 3] -= R.T @ np.array([0.02, -0.01, 0.0]) * rig.baseline_m
    wrong = replace(rig, upper=replace(rig.upper, T_cam_rig=se3.inverse(T_rig_upper)))
    drift = estimate_rig_drift(*rays(rig, around, wrong))
    assert drift is not None
    again = wrong.with_upper_moved(drift.turn, drift.shift)
    T_true, T_found = (r.lower.T_cam_rig @ se3.inverse(r.upper.T_cam_rig) for r in (rig, again))
    assert np.rad2deg(np.linalg.norm(se3.rotation_log(T_true[:3, :3].T @ T_found[:3, :3]))) < 0.01
    along = [T[:3, 3] / np.linalg.norm(T[:3, 3]) for T in (T_true, T_found)]
    assert np.linalg.norm(along[0] - along[1]) < 2e-4


def test_the_fit_is_robust_to_false_matches_and_sigmas_are_consistent(rig: Rig, around: Array) -> None:
    wrong, misses = with_upper_rotated(rig, (0.3, -0.2, 0.4)), []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        lower, upper = rays(rig, around, wrong)
        upper = upper / np.linalg.norm(upper, axis=1, keepdims=True) + 2e-3 * rng.standard_normal(upper.shape)
        upper[:60] += 0.1 * rng.standard_normal((60, 3))
        drift = estimate_rig_drift(lower, upper)
        assert drift is not None
        misses.append((np.rad2deg(drift.turn) - (0.3, -0.2, 0.4)) / np.rad2deg(drift.sigmas[:3]))
        axis = drift.turn / np.linalg.norm(drift.turn)
        assert min(drift.sigmas[:3]) < drift.angle_sigma < np.linalg.norm(drift.sigmas[:3])
        assert drift.angle_sigma**2 == pytest.approx(axis @ drift.covariance[:3, :3] @ axis)
    spread = np.sqrt(CORRELATED_POINTS * np.mean(np.square(misses)))
    assert 0.6 < spread < 1.2, "the noise here is independent"
