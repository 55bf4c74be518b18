"""Where the raw image of a camera shows the pixels of its panorama, and what is known of raw images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LAG_S: Final = 0.003  # standard deviation of the time between the exposures of two cameras that are triggered together
LEAST_PX: Final = 0.5  # by which a part of an image is displaced against the rest: less harms no pose
MEMORY_S: Final = 1.0  # time after which evidence counts as a third: vehicles change their motion more often
CAMERAS: Final = ("lower", "upper")


def camera_names(cameras: Sequence[int]) -> str:
    """Return cameras (0: lower, 1: upper) in words."""
    return " and the ".join(CAMERAS[camera] for camera in cameras) + (" cameras" if len(cameras) > 1 else " camera")


class RawImage:
    """Where the raw image of a camera shows the pixels of its panorama."""

    def __init__(self, u: NDArray[np.float32], v: NDArray[np.float32], size: tuple[int, int]) -> None:
        """u, v (H, W): raw column and row of each pixel, -1: none; size: columns and rows of the raw image."""
        self._maps, self.size = (u, v), size

    def at(self, pixels: Array) -> tuple[Array, Array]:
        """Return raw pixels (N, 2) of pixels (N, 2), NaN: none, and the derivatives (N, 2, 2) of pixels by raw ones."""
        height, width = self._maps[0].shape
        column = np.clip(np.rint(pixels[:, 0]).astype(np.intp), 2, width - 3)
        row = np.clip(np.rint(pixels[:, 1]).astype(np.intp), 2, height - 3)
        raw = np.column_stack([table[row, column] for table in self._maps]).astype(float)
        across = np.column_stack([table[row, column + 2] - table[row, column - 2] for table in self._maps]) / 4.0
        down = np.column_stack([table[row + 2, column] - table[row - 2, column] for table in self._maps]) / 4.0
        determinant = across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]
        is_shown = (raw >= 0).all(axis=1) & (np.abs(determinant) > 1e-3)
        determinant = np.where(is_shown, determinant, 1.0)
        adjugate = np.array([[down[:, 1], -down[:, 0]], [-across[:, 1], across[:, 0]]])
        return np.where(is_shown[:, None], raw, np.nan), np.moveaxis(adjugate / determinant, 2, 0)
