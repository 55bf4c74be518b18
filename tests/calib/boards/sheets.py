"""A print of a checkerboard seen straight on, rotated and scaled, with the exact pixel of every corner."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards.board import Board
from calib.boards.corner_grid import Grid
from calib.models.camera import Array
from tests.simulation.boards import SQUARE_PX, board_texture

BOARD = Board(6, 5, 0.03)
SHAPE = (300, 340)


@dataclass(frozen=True)
class Sheet:
    """An image (H, W) and its corners (rows, columns, 2) [px]."""

    image: NDArray[np.uint8]
    corners: Array

    @property
    def grey(self) -> NDArray[np.float32]:
        """The image as numbers."""
        return self.image.astype(np.float32)

    @property
    def pixels(self) -> Array:
        """The corners (N, 2), row by row."""
        return self.corners.reshape(-1, 2)

    @property
    def grid(self) -> Grid:
        """The corners by column and row."""
        return {(i, j): self.corners[j, i] for j in range(BOARD.rows) for i in range(BOARD.columns)}


def sheet(angle_deg: float = 20.0, scale: float = 1.0, noise: float = 2.0) -> Sheet:
    """Return the print in the middle of a grey image; a square has 24 px times the scale."""
    fine = cv2.resize(board_texture(BOARD), None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST)
    columns, rows = np.meshgrid(np.arange(BOARD.columns), np.arange(BOARD.rows))
    at = 3 * SQUARE_PX * (np.stack([columns, rows], axis=-1) + 2.0) - 0.5
    M = cv2.getRotationMatrix2D(((fine.shape[1] - 1) / 2, (fine.shape[0] - 1) / 2), angle_deg, scale / 3)
    M[:, 2] += np.array(SHAPE[::-1]) / 2 - 0.5 - (np.array(fine.shape[::-1]) - 1) / 2
    smooth = cv2.GaussianBlur(fine, (0, 0), 1.5 / scale)
    image = cv2.warpAffine(
        smooth, M, SHAPE[::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=225
    )
    noisy = image + noise * np.random.default_rng(4).standard_normal(SHAPE)
    return Sheet(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), at @ M[:, :2].T + M[:, 2])
