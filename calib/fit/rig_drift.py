"""How far a rig has drifted, from points that both cameras see: without a board, without knowing where the points are.

With the right rig, both rays to a point and the line through the viewpoints lie in one plane, in a panorama: on one
column. In the rectified frame, for the azimuth a and slopes z / r of the two rays, the upper camera's turn w and the
upper viewpoint's shift e aside, in parts of the baseline, move the upper column by

    -w_z + slope_upper (w_x cos a + w_y sin a) + (slope_lower - slope_upper) (e_x sin a - e_y cos a)    [rad]

A turn about the vertical moves all columns alike; a tilt moves them as one wave around, more the farther a point is
from the horizon, and not at all on it; a viewpoint aside as one wave too, more the nearer a point is. (Longuet-Higgins
1981 without the baseline's length, which no such points can tell.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib import se3
from calib.models.camera import Array
from calib.rig import Rig

MIN_POINTS = 30
ROUNDS = 12
# Of the residuals' deviation: a match that is off by more than this is wrong, and counts the less the more it is.
CUT = 2.5
MIN_SIGMA_RAD = 1e-5
STILL_RAD = 1e-6
# What is believed of the upper viewpoint before it is looked at: a mirror moves aside by no more than some degrees.
SHIFT_SIGMA_RAD = np.deg2rad(3.0)


@dataclass(frozen=True, slots=True)
class Drift:
    """What turns and shifts a rig's upper camera into its place, in the rectified frame, and how sure that is."""

    turn: Array  # (3,) rotation vector [rad], R_true = exp(turn) R_assumed
    shift: Array  # (2,) of the upper viewpoint in x, y, in parts of the baseline [rad]
    covariance: Array  # (5, 5) of both [rad^2]
    residuals: Array  # (N,) angles [rad] between the upper rays and the planes of the lower ones, afterwards
    points: int

    @property
    def turn_sigma(self) -> Array:
        """Deviations (3,) of the turn [rad]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def shift_sigma(self) -> Array:
        """Deviations (2,) of the shift [rad]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:]))


def find_drift(lower: Array, upper: Array) -> Drift | None:
    """The drift that rays (N, 3) of the same points tell, in the rectified frame; None where they are too few.

    Robust least squares by Cauchy's weights, which false matches hardly move.
    """
    if len(lower) < MIN_POINTS:
        return None
    x = np.zeros(5)
    prior = np.diag([0.0, 0, 0, SHIFT_SIGMA_RAD**-2, SHIFT_SIGMA_RAD**-2])
    for _ in range(ROUNDS):
        residual, J = _residuals(x, lower, upper), _jacobian(x, lower, upper)
        sigma = max(MIN_SIGMA_RAD, 1.4826 * float(np.median(np.abs(residual - np.median(residual)))))
        weight = 1 / (1 + (residual / (CUT * sigma)) ** 2) ** 2
        H = (J * weight[:, None]).T @ J / sigma**2 + prior
        step = np.linalg.solve(H, -(J * weight[:, None]).T @ residual / sigma**2 - prior @ x)
        x = x + step
        if np.abs(step).max() < STILL_RAD:
            break
    return Drift(x[:3], x[3:], np.asarray(np.linalg.inv(H), float), _residuals(x, lower, upper), len(lower))


def _residuals(x: Array, lower: Array, upper: Array) -> Array:
    """Sines (N,) of the angles between the upper rays and the planes of the lower rays and the baseline."""
    normal = np.cross(np.array([x[3], x[4], 1.0]), lower)
    turned = upper @ se3.rotation_exp(x[:3]).T
    lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(upper, axis=1)
    return np.asarray((normal * turned).sum(axis=1) / np.maximum(lengths, 1e-12))


def _jacobian(x: Array, lower: Array, upper: Array, step: float = 1e-6) -> Array:
    """Derivatives (N, 5)."""
    return np.column_stack([(_residuals(x + d, lower, upper) - _residuals(x - d, lower, upper)) / (2 * step)
                            for d in step * np.eye(5)])


def corrected(rig: Rig, drift: Drift) -> Rig:
    """The rig with its upper camera turned and shifted as the drift says; the baseline's length stays."""
    R_rig_rect = se3.inverse(rig.T_rect_rig)[:3, :3]
    along = np.array([*drift.shift, 1.0]) / np.linalg.norm([*drift.shift, 1.0])
    viewpoint = rig.lower.viewpoint + rig.baseline_m * R_rig_rect @ along
    R_rig_upper = R_rig_rect @ se3.rotation_exp(drift.turn) @ R_rig_rect.T @ rig.upper.T_cam_rig[:3, :3].T
    T_upper_rig = se3.inverse(se3.transform(R_rig_upper, viewpoint))
    return replace(rig, upper=replace(rig.upper, T_cam_rig=T_upper_rig))
