"""The covariance of a rig that was calibrated by boards."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.fit.boards.rig_covariance import rig_covariance
from calib.fit.boards.rig_fit import fit_rig
from calib.rig_covariance import TRANSFORM_NAMES
from calib.rig_frame import rig_between
from tests.calib.fit.boards.test_rig_fit import LOWER, ODD, RIG, UPPER, pairs


def test_covariance_describes_errors_of_noisy_corners() -> None:
    """The errors of the transform's parameters, whitened by the covariance, have a mean square of about 1."""
    squares = []
    for seed in range(8):
        found = fit_rig(pairs(ODD, noise_px=0.1, seed=seed), ODD, (LOWER, UPPER))
        rig = rig_between(found.lower, found.upper, se3.inverse(found.T_upper_lower))
        covariance = rig_covariance(found, rig)
        assert covariance.names[:2] == ("lower xi", "lower fu") and len(covariance.names) == 16
        R_rect_lower = rig.T_rect_rig[:3, :3] @ rig.lower.T_cam_rig[:3, :3].T
        T_lower_upper = se3.inverse(RIG.upper.T_cam_rig)
        turn = se3.rotation_log(R_rect_lower @ T_lower_upper[:3, :3] @ found.T_upper_lower[:3, :3] @ R_rect_lower.T)
        x, y, z = R_rect_lower @ T_lower_upper[:3, 3]
        error = np.array([*turn, x / z, y / z, RIG.baseline_m - found.baseline_m])
        squares.append(error @ np.linalg.solve(covariance.select(TRANSFORM_NAMES).matrix, error) / 6)
    assert 0.5 < np.mean(squares) < 1.8
