"""Error of views that were left out of the fit."""

from __future__ import annotations

import numpy as np

from calib.fit.boards.camera_fit import observations
from calib.fit.boards.camera_selection import select_calibration
from calib.fit.boards.cross_validation import held_out_error_px
from tests.calib.fit.boards.selected_views import BOARD, NOMINAL, SIZE, views


def test_held_out_error_of_the_right_model_is_near_the_noise() -> None:
    seen = views(NOMINAL, 8)
    selected = select_calibration(seen, BOARD, SIZE, "omni")
    found = selected.calibration
    held_out_px = held_out_error_px(found.camera, found.fit.T_cam_board, observations(found.views, BOARD))
    assert found.fit.mean_px < held_out_px < 0.05 * np.sqrt(np.pi / 2) * 1.2


def test_too_few_views_have_no_error() -> None:
    observed = observations(views(NOMINAL, 2), BOARD)
    assert held_out_error_px(NOMINAL, np.tile(np.eye(4), (2, 1, 1)), observed) == np.inf
