"""The covariance of a calibrated rig in the parameters of rig.toml, and the predicted errors of a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.fit.rig_uncertainty import drive_uncertainty, perturbed_rig
from calib.models.unified import UnifiedCamera
from calib.rig import Rig
from calib.rig_covariance import TRANSFORM_NAMES, RigCovariance
from omnid.simulation.rendering.rigs import make_rig
from tests.calib.fit.boards.test_rig_fit import RIG
from tests.simulation.rigs import lens_rig


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
    J = np.array([[1.0, -1.0], [-1.0, 1.0]]) * (5e-4 * rig.lower.camera.focal[1]) ** 2
    found = drive_uncertainty(replace(rig, covariance=RigCovariance.of_matrix(("lower fu", "lower fv"), J)))
    assert found is not None
    assert found.scale == pytest.approx(0.0049, rel=0.25)
    assert str(found).startswith("scale uncertain by 0.") and str(found).endswith("degree/m")
    assert drive_uncertainty(rig) is None


def test_parameters_are_perturbed_as_documented() -> None:
    changed = perturbed_rig(
        RIG, ("lower fu", "upper pv", *TRANSFORM_NAMES), np.array([1.0, 0.5, 0.01, -0.02, 0.03, 0.004, -0.005, 1e-3])
    )
    assert isinstance(changed.lower.camera, UnifiedCamera) and isinstance(changed.upper.camera, UnifiedCamera)
    assert changed.lower.camera.focal == pytest.approx((-204.0, 206.2))
    assert changed.upper.camera.center == pytest.approx((391.2, 383.4))
    R = RIG.T_rect_rig[:3, :3]
    np.testing.assert_allclose(
        R @ changed.upper.T_cam_rig[:3, :3].T,
        se3.rotation_exp([0.01, -0.02, 0.03]) @ R @ RIG.upper.T_cam_rig[:3, :3].T,
        atol=1e-12,
    )
    x, y, z = R @ changed.upper.viewpoint
    assert (x / z, y / z) == pytest.approx((0.004, -0.005))
    assert changed.baseline_m == pytest.approx(RIG.baseline_m + 1e-3)
    with pytest.raises(CalibError, match="no parameter 'lower a0'"):
        perturbed_rig(RIG, ("lower a0",), np.array([1.0]))


def test_points_that_a_lens_loses_on_the_way_are_left_out() -> None:
    """Its distortion ends within the image, so that points of the start have no pixel at the end of the drive."""
    camera = UnifiedCamera(0.0, (250.0, 250.0), (319.5, 239.5), (640, 480), (-0.3, 0.0, 0.0, 0.0))
    found = drive_uncertainty(with_sigma(lens_rig(camera), "baseline", 0.2e-3))
    assert found is not None and found.scale == pytest.approx(1e-3, rel=1e-2)
