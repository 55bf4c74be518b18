"""Lengths of a calibrated drive: baselines by known distances, a frame that is level where the drive was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.calibration.drive_scale import level_turn, rescaled, turned_about_lower
from omnid.simulation.rendering.rigs import make_rig
from tests.simulation.paths import loop, spline_path, vibrate


def test_a_rescaled_rig_has_a_longer_baseline_and_the_same_rotations() -> None:
    rig = make_rig(misaligned_deg=(1, 2, 3), offset_mm=(4, -3), lower_offset_mm=(30, 10))
    longer = rescaled(rig, 1.02)
    assert longer.baseline_m == pytest.approx(1.02 * rig.baseline_m)
    np.testing.assert_allclose(longer.upper.T_cam_rig[:3, :3], rig.upper.T_cam_rig[:3, :3])
    np.testing.assert_allclose(longer.lower.viewpoint, rig.lower.viewpoint)


def test_a_leaning_frame_is_levelled_by_a_flat_drive() -> None:
    lean = se3.transform(se3.rotation_exp([0.02, -0.015, 0.0]), np.zeros(3))
    poses = vibrate(loop(1, 60), 1, 0.2)
    seen = poses @ lean  # the rig frame leans on the robot
    turn = level_turn(make_rig(), se3.inverse(se3.inverse(seen[0]) @ seen))
    assert turn is not None
    np.testing.assert_allclose(turn, lean[:3, :3], atol=1.5e-3)


def test_the_level_is_that_of_the_base() -> None:
    """A rig that hangs upside down on its robot is level too."""
    T_base_rig = se3.transform(se3.rotation_exp([np.pi, 0.0, 0.0]) @ se3.rotation_exp([0.0, 0.01, 0.0]), [0, 0, 1.0])
    rig = replace(make_rig(), T_base_rig=se3.transform(se3.rotation_exp([np.pi, 0.0, 0.0]), [0, 0, 1.0]))
    turn = level_turn(rig, se3.inverse(loop(2, 60) @ T_base_rig))
    assert turn is not None
    np.testing.assert_allclose(se3.rotation_log(turn), [0.0, 0.01, 0.0], atol=1e-6)


@pytest.mark.parametrize(
    "poses",
    [
        spline_path(1, 40, 0.05, sway_m=0.01),
        vibrate(loop(1, 60), 1, 0.2, shake_mm=40.0),
        loop(1, 60) @ se3.transform(se3.rotation_exp([0.1, 0, 0]), np.zeros(3)),
    ],
    ids=["straight", "rough", "far off"],
)
def test_a_path_without_a_plane_of_the_base_changes_nothing(poses: np.ndarray) -> None:
    assert level_turn(make_rig(), se3.inverse(se3.inverse(poses[0]) @ poses)) is None


def test_a_turned_rig_keeps_its_lower_viewpoint_and_the_transform_between_its_cameras() -> None:
    rig = make_rig(misaligned_deg=(1, 2, 3), lower_offset_mm=(30, 10))
    R = se3.rotation_exp([0.01, 0.02, 0.0])
    turned = turned_about_lower(rig, R)
    np.testing.assert_allclose(turned.lower.viewpoint, rig.lower.viewpoint, atol=1e-12)
    between = [r.upper.T_cam_rig @ se3.inverse(r.lower.T_cam_rig) for r in (rig, turned)]
    np.testing.assert_allclose(between[0], between[1], atol=1e-12)
    np.testing.assert_allclose(turned.lower.T_cam_rig[:3, :3] @ R, rig.lower.T_cam_rig[:3, :3], atol=1e-12)
