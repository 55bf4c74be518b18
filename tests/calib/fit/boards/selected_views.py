"""Views of a board by a camera of known model, for the selection of models."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.boards.board import Board, BoardView
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
