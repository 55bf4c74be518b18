"""What residuals and the covariance of a rig say of its accuracy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.boards.board import Board
from calib.fit.residual_structure import residual_structure
from calib.fit.rig_uncertainty import drive_uncertainty
from calib.models.unified import UnifiedCamera
from calib.rig import Rig, RigCovariance
from tests.simulation.rigs import make_rig

CENTER = (384.0, 380.0)
BOARD = Board(6, 5, 0.03)
# 40 boards of about 100 px on all sides of the image.
MIDDLES = np.random.default_rng(0).uniform(80, 580, (40, 1, 2))
PIXELS = MIDDLES + 700 * BOARD.points[:, :2]
OFFSET = PIXELS - CENTER
NOISE = np.random.default_rng(1).standard_normal(PIXELS.shape)


def test_noise_alone_has_no_systematic_part() -> None:
    structure = residual_structure(PIXELS.reshape(-1, 2), 0.3 * NOISE.reshape(-1, 2), CENTER)
    assert structure.systematic_px < 0.06 and structure.noise_px == pytest.approx(0.3, rel=0.05)
    assert not structure.is_misfit


@pytest.mark.parametrize(
    "field",
    [
        0.3
        * np.sin(np.linalg.norm(OFFSET, axis=2, keepdims=True) / 60)
        * OFFSET
        / np.linalg.norm(OFFSET, axis=2, keepdims=True),
        0.3 * np.cos(2 * np.arctan2(OFFSET[..., 1:], OFFSET[..., :1])) * np.array([[1.0, 0.5]]),
    ],
)
def test_a_smooth_field_is_a_misfit(field: np.ndarray) -> None:
    structure = residual_structure(PIXELS.reshape(-1, 2), (field + 0.05 * NOISE).reshape(-1, 2), CENTER)
    rms = float(np.sqrt((field**2).mean()))
    assert structure.is_misfit and 0.6 * rms < structure.systematic_px < 1.1 * rms


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
    assert str(found).startswith("scale uncertain by 0.") and str(found).endswith("degree/m (one sigma)")
    assert drive_uncertainty(rig) is None
