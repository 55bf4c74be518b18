"""Fit of an `omni` camera to board views."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.board import Board
from calib.fit.boards.camera_fit import CameraCalibration, fit_camera, refine_camera_calibration
from calib.fit.boards.camera_models import Model
from calib.fit.boards.unified_fit import unified_from_ocam
from calib.models.camera import Array, Mask
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera
from omnid.simulation.rendering.sensor import Sensor
from tests.simulation.boards import BoardRenderer, board_poses_around_camera

BOTH: tuple[Model, Model] = ("ocam", "omni")


BOARD = Board(7, 6, 0.03)


MASK = Mask((394.2, 380.9), 60.0, 372.0)


SIZE = (780, 768)


OMNI = UnifiedCamera(0.93, (-205.0, 206.2), MASK.center, SIZE)


def rendered() -> tuple[CameraCalibration, CameraCalibration]:
    """Calibrate an ocam and an omni camera by rendered images."""
    from calib.boards.board_finder import find_board

    renderer = BoardRenderer.of(BOARD, OMNI, MASK)
    poses = board_poses_around_camera(OMNI, BOARD, MASK, 8, seed=3, distance_m=(0.12, 0.28))
    images = {
        str(k): renderer.render_board(T, seed=k, sensor=Sensor(noise_sigma=1.0)).image for k, T in enumerate(poses)
    }
    views = [found.view for name, image in images.items() if (found := find_board(image, BOARD, name)).view]
    assert len(views) == 8
    both = []
    for model in BOTH:
        first = fit_camera([view for view in views if view], BOARD, SIZE, model)
        both.append(refine_camera_calibration(first, images, model, "mirror"))
    return both[0], both[1]


@pytest.mark.slow
def test_recovers_scale_and_centre_from_rendered_boards() -> None:
    ocam, omni = rendered()
    assert isinstance(omni.camera, UnifiedCamera) and isinstance(ocam.camera, OcamCamera)
    assert max(ocam.fit.mean_px, omni.fit.mean_px) < 0.03
    for found in (ocam, omni):
        assert found.camera.center == pytest.approx(OMNI.center, abs=0.1)
    assert omni.camera.focal == pytest.approx(OMNI.focal, rel=5e-4)
    pixels = MASK.center + np.linspace(80, 340, 20)[:, None] * np.array([[0.6, 0.8]])
    angles: list[Array] = []
    for camera in (ocam.camera, OMNI):
        axis = camera.lift(np.array([camera.center]))[0]
        angles.append(np.arccos(camera.lift(pixels) @ axis))
    assert np.abs(angles[0] / angles[1] - 1).max() < 1e-3
    difference = omni.camera.lift(pixels) - ocam.camera.lift(pixels) @ unified_from_ocam(ocam.camera)[:3, :3].T
    assert np.linalg.norm(difference, axis=1).max() < 1e-3
