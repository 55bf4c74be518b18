"""Estimate of how a printed board differs from its drawing: bends and stretch, adjusted with camera and poses.

It begins with the camera and the poses of a fit that took the board as drawn.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.boards.print_shape import AS_DRAWN, BENDS, MODE_NAMES, PrintShape, all_modes, significant_part
from calib.errors import CalibError
from calib.fit.boards.bundle import Observations, Parameters, Prior, adjust_bundle
from calib.models.camera import Array

# Least squared Mahalanobis distance from the drawing, because a board as drawn exceeds it once in ten thousand
# calibrations (chi-square of three bends, and of the stretch).
MIN_CHI2_BENDS, MIN_CHI2_STRETCH = 21.1, 15.1


def find_print_shape(
    parameters: Parameters, fitted: Observations, T_cam_board: Array, prior: Prior | None = None
) -> PrintShape:
    """Return the significant part of the print's shape; AS_DRAWN where the adjustment fails.

    parameters: about the fitted camera. fitted: observations with the drawing's points.
    T_cam_board: fitted poses (K, 4, 4) of the board as drawn.
    """
    free = replace(fitted, modes=all_modes(fitted.points))
    try:
        found = adjust_bundle(parameters, T_cam_board, free, prior=prior)
    except (CalibError, np.linalg.LinAlgError):
        return AS_DRAWN
    bends, stretch = slice(0, BENDS), slice(BENDS, len(MODE_NAMES))
    kept = [
        _chi2(found.board_steps[part], found.board_covariance[part, part]) > least
        for part, least in ((bends, MIN_CHI2_BENDS), (stretch, MIN_CHI2_STRETCH))
    ]
    return significant_part(found.board_steps, np.repeat(kept, [BENDS, len(MODE_NAMES) - BENDS]))


def _chi2(steps: Array, covariance: Array) -> float:
    """Return the squared Mahalanobis distance of steps from 0."""
    return float(steps @ np.linalg.lstsq(covariance, steps, rcond=None)[0])
