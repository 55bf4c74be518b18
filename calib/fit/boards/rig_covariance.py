"""The covariance of a rig that was calibrated by boards."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.fit.boards.rig_fit import RigCalibration
from calib.fit.rig_uncertainty import central_differences
from calib.models.camera import Array
from calib.rig import Rig
from calib.rig_covariance import TRANSFORM_NAMES, RigCovariance

# Step of the derivatives by twists [m, rad]: the transform is nearly linear over it, and 1e10 times its rounding.
TWIST_STEP = 1e-6


def rig_covariance(found: RigCalibration, rig: Rig) -> RigCovariance:
    """Return the covariance of a calibration's parameters for its rig."""
    names = [
        f"{side} {name}"
        for side, values in zip(("lower", "upper"), found.parameters, strict=True)
        for name, _, _ in values
    ]
    J = np.eye(len(found.covariance))
    J[len(names) :, len(names) :] = _transform_by_twist(found.T_upper_lower, rig)
    return RigCovariance.of_matrix([*names, *TRANSFORM_NAMES], J @ found.covariance @ J.T)


def _transform_by_twist(T_upper_lower: Array, rig: Rig) -> Array:
    """Return the derivatives (6, 6) of the parameters TRANSFORM_NAMES by twists of T_upper_lower."""
    R_rect_lower = rig.T_rect_rig[:3, :3] @ rig.lower.T_cam_rig[:3, :3].T
    R_upper_rect = T_upper_lower[:3, :3] @ R_rect_lower.T

    def values(twist: Array) -> Array:
        T_lower_upper = se3.inverse(se3.exp(twist) @ T_upper_lower)
        turn = se3.rotation_log(R_rect_lower @ T_lower_upper[:3, :3] @ R_upper_rect)
        x, y, z = R_rect_lower @ T_lower_upper[:3, 3]
        return np.array([*turn, x / z, y / z, np.linalg.norm(T_lower_upper[:3, 3])])

    return central_differences(values, TWIST_STEP * np.ones(6))
