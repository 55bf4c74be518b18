"""Drift of a rig, estimated from points of unknown position that both cameras see.

With a correct rig, both rays to a point and the line through the viewpoints lie in one plane: on one column of the
panoramas. In the rectified frame, with azimuth a and slopes z / r of the two rays, a rotation w of the upper camera and
a lateral shift e of the upper viewpoint, as a fraction of the baseline, move the upper column by

    -w_z + slope_upper (w_x cos a + w_y sin a) + (slope_lower - slope_upper) (e_x sin a - e_y cos a)    [rad]

A rotation about the vertical moves all columns equally. A tilt moves them by one sine wave over the azimuth, which
grows with the distance from the horizon. A shifted viewpoint moves them by one sine wave, which grows with the nearness
of the point. (Longuet-Higgins 1981. The length of the baseline is not observable.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib import se3
from calib.fit.least_squares import BEST_STEP, KERNEL_WIDTH, central_differences, robust_sigma
from calib.models.camera import NEWTON_STEPS, Array

# Points that count as one: neighbours share their texture, and so the error of the match, in all pairs that show it.
# With 1, the rotation of right rigs is off by 1.1 to 3.8 sigma (rms of drives of development seeds, see
# tests/bench/calibration.py); clusters of 10 degrees or of whole pairs explain no more of it than 1 does.
CORRELATED_POINTS = 4.0
# Prior of the upper viewpoint's lateral shift: a mirror moves by no more than some degrees of the baseline.
SHIFT_SIGMA_RAD = np.deg2rad(3.0)


@dataclass(frozen=True, slots=True)
class RigDrift:
    """Rotation and shift of a rig's upper camera to its true pose, in the rectified frame, with covariance."""

    turn: Array  # (3,) rotation vector [rad], R_true = exp(turn) R_assumed
    shift: Array  # (2,) of the upper viewpoint in x, y, as a fraction of the baseline [rad]
    covariance: Array  # (5, 5) of turn and shift [rad^2]
    residuals: Array  # (N,) angles [rad] between the upper rays and the planes of the lower ones, afterwards
    points: int

    @property
    def sigmas(self) -> Array:
        """Return the standard deviations (5,) of turn and shift [rad]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def angle_sigma(self) -> float:
        """Return the standard deviation of the angle of the rotation [rad]: along its axis."""
        angle = float(np.linalg.norm(self.turn))
        axis = self.turn / angle if angle > 0 else np.full(3, 3**-0.5)
        return float(np.sqrt(axis @ self.covariance[:3, :3] @ axis))


def estimate_rig_drift(lower: Array, upper: Array) -> RigDrift:
    """Estimate the drift from rays (N, 3) to the same points, in the rectified frame.

    Iteratively reweighted least squares; the weights (Geman and McClure 1987) limit the influence of false matches.
    """
    x = np.zeros(5)
    prior = np.diag([0.0, 0, 0, SHIFT_SIGMA_RAD**-2, SHIFT_SIGMA_RAD**-2])
    for _ in range(NEWTON_STEPS):
        residual, about = _residuals(x, lower, upper), x
        J = central_differences(
            lambda step, about=about: _residuals(about + step, lower, upper),  # type: ignore[misc]
            BEST_STEP * np.ones(len(x)),
        )
        sigma = robust_sigma(residual - np.median(residual))
        weight = 1 / (1 + (residual / (KERNEL_WIDTH * sigma)) ** 2) ** 2
        variance = CORRELATED_POINTS * sigma**2
        H = (J * weight[:, None]).T @ J / variance + prior
        x = x + np.linalg.solve(H, -(J * weight[:, None]).T @ residual / variance - prior @ x)
    return RigDrift(x[:3], x[3:], np.asarray(np.linalg.inv(H), float), _residuals(x, lower, upper), len(lower))


def _residuals(x: Array, lower: Array, upper: Array) -> Array:
    """Return the sines (N,) of the angles between the upper rays and the planes of lower rays and baseline."""
    normal = np.cross(np.array([x[3], x[4], 1.0]), lower)
    turned = upper @ se3.rotation_exp(x[:3]).T
    lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(upper, axis=1)
    return np.asarray((normal * turned).sum(axis=1) / np.maximum(lengths, 1e-12))
