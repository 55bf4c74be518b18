"""Division of residuals into a systematic part and noise."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.board import Board
from calib.fit.residual_structure import residual_structure

CENTER = (384.0, 380.0)
BOARD = Board(6, 5, 0.03)
# 40 boards of about 100 px on all sides of the image.
MIDDLES = np.random.default_rng(0).uniform(80, 580, (40, 1, 2))
PIXELS = MIDDLES + 700 * BOARD.points[:, :2]
OFFSET = PIXELS - CENTER
NOISE = np.random.default_rng(1).standard_normal(PIXELS.shape)


def test_noise_alone_has_no_systematic_part() -> None:
    structure = residual_structure(PIXELS, 0.3 * NOISE, BOARD.points, CENTER)
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
    structure = residual_structure(PIXELS, field + 0.05 * NOISE, BOARD.points, CENTER)
    rms = float(np.sqrt((field**2).mean()))
    assert structure.is_misfit and 0.6 * rms < structure.systematic_px < 1.1 * rms
