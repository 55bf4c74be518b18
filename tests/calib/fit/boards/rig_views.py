"""Views of boards by both cameras of a known rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib import se3
from calib.boards.board import Board, BoardView
from calib.fit.boards.rig_problem import PairView
from calib.models.camera import Array, Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from tests.simulation.boards import board_poses_around_rig

LOWER = UnifiedCamera(0.93, (-205.0, 206.2), (394.2, 380.9), (780, 768))


UPPER = UnifiedCamera(0.97, (-207.0, 206.2), (391.2, 382.9), (780, 768))


T_UPPER_LOWER = se3.transform(se3.rotation_exp([0.02, -0.015, 0.3]), [0.004, -0.006, 0.18])


RIG = Rig(
    MountedCamera(LOWER, np.eye(4), Mask(LOWER.center, 60.0, 372.0)),
    MountedCamera(UPPER, T_UPPER_LOWER, Mask(UPPER.center, 60.0, 372.0)),
)


ODD, EVEN, SQUARE = Board(7, 6, 0.03), Board(8, 6, 0.03), Board(6, 6, 0.03)


def pairs(board: Board, count: int = 10, noise_px: float = 0.0, seed: int = 0) -> list[PairView]:
    rng = np.random.default_rng(seed)
    made = []
    for k, T in enumerate(board_poses_around_rig(RIG, board, count, seed=seed)):
        both = [m.camera.project(se3.apply(m.T_cam_rig @ T, board.points)) for m in (RIG.lower, RIG.upper)]
        lower, upper = (BoardView(f"p{k}", pixels + noise_px * rng.standard_normal(pixels.shape)) for pixels in both)
        made.append(PairView(f"p{k}", (lower, upper)))
    return made


def with_upper_order(view: PairView, order: Array) -> PairView:
    lower, upper = view.seen
    assert upper
    return replace(view, seen=(lower, replace(upper, pixels=upper.pixels[order])))
