"""The errors of a rig with a covariance, and their effect on the motion that the rig measures."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib import se3
from calib.fit.least_squares import BEST_STEP, central_differences
from calib.fit.parameters import moved_rig
from calib.models.camera import Array
from calib.rig import Rig, RigCovariance

# The place of the predicted drive: walls around the rig at these distances [m], seen at these slopes z/r.
WALLS_M, SLOPES, AZIMUTHS = (1.2, 2.0, 4.0), np.linspace(-0.9, 0.6, 11), 16
# Length [m] and turn [rad] of the predicted motions, short against WALLS_M.
MOTION = 0.1
# A rig whose file states no covariance may be wrong by this: the turn of one camera against the other, and the part of
# the baseline, which is that of all lengths.
UNSTATED_TURN_RAD, UNSTATED_SCALE = math.radians(0.05), 0.002


@dataclass(frozen=True, slots=True)
class DriveUncertainty:
    """Standard deviations of a drive's length (relative) and heading (per metre) by the errors of a rig."""

    scale: float
    heading_rad_m: float

    def __str__(self) -> str:
        heading_deg_m = float(np.rad2deg(self.heading_rad_m))
        return f"scale uncertain by {100 * self.scale:.2g} %, heading by {heading_deg_m:.2g} degree/m (one sigma)"


def drive_uncertainty(rig: Rig) -> DriveUncertainty | None:
    """Predict the errors of a drive by the covariance of its rig; None if it has none or sees too little.

    A drive among walls: points are triangulated by both cameras at its start, then the pose at its end is fitted to
    their pixels in both cameras, all to first order. Errors are root mean squares of drives along x and along y.
    """
    if rig.covariance is None:
        return None
    J = motion_errors(rig).at(WALLS_M[1])
    scale, heading_rad_m = (
        float(np.linalg.norm([J[of, axis] for axis, of in enumerate(rows)])) / math.sqrt(2)
        for rows in ((0, 1), (-1, -1))
    )
    return DriveUncertainty(scale, heading_rad_m) if scale else None


@dataclass(frozen=True, slots=True)
class MotionErrors:
    """How wrong motions are measured by the K independent errors of a rig, of one sigma each, to first order.

    [:, d, k] is the error [t; r] of a measured motion, per metre or radian along axis d of the rectified frame, by
    error k. A turn of one camera against the other displaces points by the square of their distance, while the motion
    moves them by its inverse: so the derivatives are linear in the distance of what is seen.
    """

    constant: Array  # (6, 6, K)
    per_m: Array  # (6, 6, K) by the median distance of what is seen

    def at(self, distance_m: float) -> Array:
        """Return the derivatives (6, 6, K) where the median of what is seen is so far away."""
        return np.asarray(self.constant + distance_m * self.per_m)


def motion_errors(rig: Rig) -> MotionErrors:
    """Return the errors of motions by the rig's covariance, or by UNSTATED_* where it has none."""
    covariance = rig.covariance
    if covariance is None:
        turn, longer = UNSTATED_TURN_RAD, UNSTATED_SCALE * rig.baseline_m
        variances = np.square([turn, turn, turn, longer])
        covariance = RigCovariance.of_matrix(("r_x", "r_y", "r_z", "baseline"), np.diag(variances))
    # 1. Independent errors: a root of the correlations, whose eigenvalues may be negative by rounding.
    is_open = covariance.sigmas > 0
    eigenvalues, vectors = np.linalg.eigh(covariance.correlation * np.outer(is_open, is_open))
    root = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))
    # 2. The motions along all axes by each parameter, in sigmas, among the walls and among some that are twice as far;
    #    every second of the points is enough.
    scaled, near_m = (covariance.names, np.maximum(covariance.sigmas, np.finfo(float).tiny)), WALLS_M[1]
    derivatives = []
    for factor in (1.0, 2.0):
        points = factor * seen_points(rig)[::2]
        along = [_motion_by_parameters(rig, points, MOTION * axis, scaled) for axis in np.eye(6)]
        none = np.zeros((6, len(covariance.names)))
        derivatives.append(np.stack([none if J is None else J / MOTION @ root for J in along], axis=1))
    near, far = derivatives
    per_m = (far - near) / near_m
    return MotionErrors(near - near_m * per_m, per_m)


def seen_points(rig: Rig) -> Array:
    """Return points (N, 3) in the rectified frame, on walls around the rig, that both cameras see."""
    azimuth, slope, distance = (
        part.ravel() for part in np.meshgrid(2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS, SLOPES, WALLS_M)
    )
    points = distance[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth), slope])
    pixels = _pixels(rig, se3.apply(se3.inverse(rig.T_rect_rig), points))
    seen = [
        mounted.visible.contains(side)
        for mounted, side in zip((rig.lower, rig.upper), np.split(pixels, 2, axis=1), strict=True)
    ]
    return np.asarray(points[np.isfinite(pixels).all(axis=1) & seen[0] & seen[1]])


def _pixels(rig: Rig, in_rig: Array) -> Array:
    """Return the pixels (N, 4) in the lower and the upper camera of points (N, 3) in the rig frame."""
    return np.column_stack(
        [mounted.camera.project(se3.apply(mounted.T_cam_rig, in_rig)) for mounted in (rig.lower, rig.upper)]
    )


def _motion_by_parameters(
    rig: Rig, points: Array, motion: Array, scaled: tuple[tuple[str, ...], Array]
) -> Array | None:
    """Return the derivatives (6, P) of a measured motion (6,) [t; r] of the rig by parameters in units of scaled.

    None where the cameras see too few points from both ends: a model of a lens may have no pixel for some of them.

    The points' pixels stay the same. Their triangulation at the start: J_point dX + J_parameter = 0. The pose at the
    end, by the same pixels' equations: J_point dX + J_pose dp + J_parameter = 0, in least squares.
    """
    T_rig_rect, (names, units) = se3.inverse(rig.T_rect_rig), scaled

    def derivatives(points: Array) -> Array:
        """Return those (N, 4, 3 + P) of the pixels of points by their position and by the parameters."""

        def pixels(changes: Array) -> Array:
            shift, own = np.split(changes, [3])
            moved = moved_rig(rig, dict(zip(names, (own * units).tolist(), strict=True)))
            return _pixels(moved, se3.apply(T_rig_rect, points + shift))

        return central_differences(pixels, np.repeat([BEST_STEP, 1.0], [3, len(names)]))

    T_end_start = se3.inverse(se3.exp(motion))
    ends = se3.apply(T_end_start, points)
    start, end = derivatives(points), derivatives(ends)
    seen = np.isfinite(start).all(axis=(1, 2)) & np.isfinite(end).all(axis=(1, 2))
    if seen.sum() < len(motion):
        return None
    (by_start, first), (by_end, last) = (np.split(part[seen], [3], axis=2) for part in (start, end))
    shift = -se3.R_of(T_end_start) @ np.linalg.pinv(by_start) @ first  # (N, 3, P), in the axes of the end
    # The pose moves and turns the points the other way: dX_end = -dp - w x X_end.
    by_pose = np.concatenate([-by_end, by_end @ se3.hat(ends[seen])], axis=2)
    right = (by_end @ shift + last).reshape(-1, first.shape[2])
    return np.asarray(-np.linalg.lstsq(by_pose.reshape(-1, 6), right, rcond=None)[0])
