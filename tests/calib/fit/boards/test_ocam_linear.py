"""Linear initialisation of an `ocam` camera and board poses."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.board import Board
from calib.fit.boards.bundle import Observations
from calib.fit.boards.ocam_linear import solve_linear
from calib.models.ocam import OcamCamera
from tests.calib.fit.boards.test_camera_fit import seen_by

BOARD = Board(7, 6, 0.03)


SIZE = (780, 768)


OCAM = OcamCamera((-131.6, 0.0, 1.9e-3, 9e-8, -6e-10), (380.9, 394.2), (0.998, 2e-4, 2e-4), SIZE)


def test_linear_solution_is_close() -> None:
    views = seen_by(OCAM, noise_px=0.2)
    linear = solve_linear(Observations(np.array([view.pixels for view in views]), BOARD.points), SIZE, 4, "mirror")
    assert linear.center == pytest.approx(OCAM.center_row_column, abs=2.5)
    assert linear.coefficients[0] == pytest.approx(-131.6, rel=0.02)
