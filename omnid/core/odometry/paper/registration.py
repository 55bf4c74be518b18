"""Motion between two clouds of the same points: RANSAC and Gauss-Newton of Dang et al. 2012, IV.B and IV.C."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.pose_estimation import CONVERGED, GAUSS_NEWTON_STEPS, rigid_fit

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

HYPOTHESES = 200  # of RANSAC, because if half of the points are wrong, (1 - 0.5^3)^200 = 3e-12 of the searches fail.
MIN_POINTS = 3  # because fewer leave a rotation about their line open

X, Y, Z = np.eye(3)


@dataclass(frozen=True, slots=True)
class Registration:
    """Motion M (4, 4) of the points, b = M a, and its covariance (6, 6) [t; r] on the left of M."""

    M: Array
    covariance: Array


def euler_matrix(parameters: Array) -> Array:
    """Return M (4, 4) of (rx, ry, rz, tx, ty, tz) [rad, m]: the rotation Rz Ry Rx, then the translation; eq. (7)."""
    rx, ry, rz = parameters[:3]
    R = se3.rotation_exp(rz * Z) @ se3.rotation_exp(ry * Y) @ se3.rotation_exp(rx * X)
    return se3.transform(R, parameters[3:])


def euler_parameters(M: Array) -> Array:
    """Return (rx, ry, rz, tx, ty, tz) [rad, m] of M (4, 4), the inverse of eq. (7) for pitches below a right angle."""
    R = M[:3, :3]
    angles = (
        np.arctan2(R[2, 1], R[2, 2]),
        np.arctan2(-R[2, 0], np.hypot(R[2, 1], R[2, 2])),
        np.arctan2(R[1, 0], R[0, 0]),
    )
    return np.concatenate([angles, M[:3, 3]])


def consensus(a: Array, b: Array, rng: np.random.Generator, threshold_m: float) -> tuple[Array, Flags]:
    """Return the motion M (4, 4), b = M a, with the largest consensus set within threshold_m, and its flags (N,).

    Three pairs of points (N, 3) give a hypothesis. The paper finds it by Gauss-Newton on eq. (9); the closed form has
    the same minimum.
    """
    if len(a) < MIN_POINTS:
        return np.eye(4), np.zeros(len(a), bool)
    triples = rng.random((HYPOTHESES, len(a))).argpartition(2, axis=1)[:, :3]
    motions = rigid_fit(a[triples], b[triples])
    agree = np.linalg.norm(se3.apply(motions, a) - b, axis=-1) < threshold_m
    best = int(agree.sum(axis=1).argmax())
    return motions[best], agree[best]


def register(a: Array, b: Array, M: Array) -> Registration:
    """Return the motion that minimises sum |b - M a|^2 over points (N, 3), N > 2, from a start M: eq. (9).

    Gauss-Newton; the unknowns are the paper's three angles and three translations. The covariance is estimated from the
    residuals (White 1980), so it includes that far points are noisier, which eq. (9) ignores; it excludes the bias.
    """
    parameters = euler_parameters(M)
    for _ in range(GAUSS_NEWTON_STEPS):
        J, error = _linearised(a, b, parameters)
        step = np.linalg.lstsq(J.reshape(-1, 6), error.ravel(), rcond=None)[0]
        parameters = parameters + step
        if np.abs(step).max() < CONVERGED:
            break
    M = euler_matrix(parameters)
    return Registration(M, _covariance(se3.apply(M, a), b))


def _linearised(a: Array, b: Array, parameters: Array) -> tuple[Array, Array]:
    """Return the Jacobians (N, 3, 6) of M a by the parameters, and the errors b - M a (N, 3)."""
    M = euler_matrix(parameters)
    turned = a @ M[:3, :3].T
    # The axis of each angle, after the rotations to its left have been applied: R = Rz Ry Rx.
    Rz, Ry = se3.rotation_exp(parameters[2] * Z), se3.rotation_exp(parameters[1] * Y)
    axes = np.column_stack([Rz @ Ry @ X, Rz @ Y, Z])
    by_shift = np.broadcast_to(np.eye(3), (len(a), 3, 3))
    return np.concatenate([-se3.hat(turned) @ axes, by_shift], axis=2), b - turned - M[:3, 3]


def _covariance(moved: Array, b: Array) -> Array:
    """Return the covariance (6, 6) of a small motion [t; r] on the left of M, from the remaining errors."""
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(b), 3, 3)), -se3.hat(moved)], axis=2)
    slopes = (np.swapaxes(J, 1, 2) @ (b - moved)[:, :, None])[:, :, 0]
    H = np.linalg.pinv(np.einsum("nij,nik->jk", J, J))
    freedom = len(b) / max(1, len(b) - 2)  # six unknowns use up the errors of two points
    return np.asarray(freedom * H @ (slopes.T @ slopes) @ H)
