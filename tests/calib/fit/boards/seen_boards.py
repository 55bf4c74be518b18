"""Boards seen by a camera that is known, to the noise of their corners."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.boards.board import Board, BoardView
from calib.fit.boards.bundle import Observations
from calib.models.camera import Array, Mask
from calib.models.ocam import OcamCamera
from tests.simulation.boards import board_poses_around_camera

BOARD = Board(7, 6, 0.03)
SIZE = (780, 768)
MASK = Mask((394.2, 380.9), 60.0, 372.0)
OCAM = OcamCamera((-131.6, 0.0, 1.9e-3, 9e-8, -6e-10), (380.9, 394.2), (0.998, 2e-4, 2e-4), SIZE)


def observed_boards(count: int = 8, noise_px: float = 0.0) -> tuple[Array, Observations]:
    """Return poses T_cam_board (K, 4, 4) and what OCAM sees of them."""
    poses = np.array(board_poses_around_camera(OCAM, BOARD, MASK, count, seed=1, elevation_deg=(35.0, 100.0)))
    pixels = np.array([OCAM.project(se3.apply(T, BOARD.points)) for T in poses])
    return poses, Observations(pixels + noise_px * np.random.default_rng(3).standard_normal(pixels.shape), BOARD.points)


def views_of(pixels: Array) -> list[BoardView]:
    """Return pixels (K, N, 2) as views."""
    return [BoardView(f"view{k}", seen) for k, seen in enumerate(pixels)]
