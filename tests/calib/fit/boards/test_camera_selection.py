"""Selection of the camera model: ray-traced mirrors, cross-validation, misfit of a model that is too simple."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from calib.boards.board import Board, BoardView
from calib.fit.boards.camera_selection import MODELS, camera_structure, select_calibration
from calib.models.camera import Mask
from calib.models.unified import UnifiedCamera
from tests.simulation.boards import board_poses_around_camera
from tests.simulation.mirrors import MirrorCamera

BOARD = Board(7, 6, 0.03)


SIZE = (768, 768)


MASK = Mask((384.2, 381.1), 45.0, 370.0)


NOMINAL = UnifiedCamera(1.0, (-207.0, 207.0), MASK.center, SIZE)


def views(
    camera: MirrorCamera | UnifiedCamera, count: int = 12, noise_px: float = 0.05, seed: int = 0
) -> list[BoardView]:
    rng = np.random.default_rng(seed)
    poses = board_poses_around_camera(NOMINAL, BOARD, MASK, count, seed=seed, distance_m=(0.2, 0.45))
    return [
        BoardView(f"view{k}", camera.project(se3.apply(T, BOARD.points)) + noise_px * rng.standard_normal((42, 2)))
        for k, T in enumerate(poses)
    ]


# A camera tilted by half a degree under a mirror 1 % off the paraboloid.
TILTED = MirrorCamera(207.0, MASK.center, SIZE, tilt_rad=(0.007, -0.005), conic=0.01, ellipticity=0.01)


@pytest.mark.slow
def test_selects_a_model_that_describes_a_tilted_camera() -> None:
    selected = select_calibration(views(TILTED), BOARD, SIZE)
    assert selected.model != "ocam" and [score.model for score in selected.scores] == list(MODELS)
    by_model = {score.model: score for score in selected.scores}
    assert (
        by_model["ocam"].structure.is_misfit and by_model["ocam"].held_out_px > 2 * by_model[selected.model].held_out_px
    )
    assert not camera_structure(selected.calibration).is_misfit
    assert selected.calibration.fit.mean_px < 0.08
