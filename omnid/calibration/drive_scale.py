"""Lengths that a rig measures: their change by its parameters, known distances, and the level of its frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.fit.drive.adjustment import DriveAdjustment
from calib.rig import Rig
from omnid.core.stereo.triangulation import common_perpendicular

Array = NDArray[np.float64]

GRADIENT_STEP = 0.01
MAX_LEVEL_RAD = np.deg2rad(3.0)  # Most tilt of a frame that was meant to be level.
MIN_EXTENT_M = 0.3  # Least shorter side of a path that determines its plane.
MAX_ROUGHNESS = 0.02  # Most rms distance of a path from its plane, by the shorter side.


def scale_gradient(found: DriveAdjustment) -> Array:
    """Return the relative change (P,) of lengths by each step of the rig, for the same pixels.

    Depth comes from the rays of both cameras to the same pixels; near landmarks count more, as in the odometry.
    """
    pixels = _common_pixels(found)
    ranges = _ranges(found.rig, pixels)
    weight = np.where(np.isfinite(ranges), ranges**-2, 0.0)
    gradient = np.zeros(len(found.prior))
    for k, step in enumerate(GRADIENT_STEP * np.eye(len(found.prior))):
        ahead, behind = (_ranges(found.parameters.at(found.state.steps + sign * step), pixels) for sign in (1, -1))
        change = np.nan_to_num(np.log(ahead / behind))
        gradient[k] = float(weight @ change / weight.sum()) / (2 * GRADIENT_STEP)
    return gradient


def scale_change(found: DriveAdjustment, before: Rig) -> float:
    """Return the relative change of lengths from the rig before to the adjusted one, for the same pixels."""
    pixels = _common_pixels(found)
    ranges, old = _ranges(found.rig, pixels), _ranges(before, pixels)
    known = np.isfinite(ranges) & np.isfinite(old)
    return float(np.average(np.log(ranges[known] / old[known]), weights=ranges[known] ** -2)) if known.any() else np.nan


def _common_pixels(found: DriveAdjustment) -> tuple[Array, Array]:
    """Return the pixels (N, 2) of landmarks that both cameras saw at once, in the lower and in the upper image."""
    seen = found.observations
    key = seen.keyframe * (seen.landmark.max() + 1) + seen.landmark
    _, lower, upper = np.intersect1d(key[seen.camera == 0], key[seen.camera == 1], return_indices=True)
    return seen.pixels[seen.camera == 0][lower], seen.pixels[seen.camera == 1][upper]


def _ranges(rig: Rig, pixels: tuple[Array, Array]) -> Array:
    """Return the distances (N,) from the lower viewpoint of points at pixels (N, 2) of both cameras."""
    rays = [m.camera.lift(p) @ m.T_cam_rig[:3, :3] for m, p in zip((rig.lower, rig.upper), pixels, strict=True)]
    points = common_perpendicular(rays[0], rays[1], rig.upper.viewpoint - rig.lower.viewpoint)
    return np.asarray(np.linalg.norm(points, axis=1))


def rescaled(rig: Rig, ratio: float) -> Rig:
    """Return the rig with a longer or shorter baseline: all lengths of its odometry change by that ratio."""
    viewpoint = rig.lower.viewpoint + ratio * (rig.upper.viewpoint - rig.lower.viewpoint)
    R_upper_rig = rig.upper.T_cam_rig[:3, :3]
    return replace(rig, upper=replace(rig.upper, T_cam_rig=se3.transform(R_upper_rig, -R_upper_rig @ viewpoint)))


def level_turn(rig: Rig, T_rig_odom: Array) -> Array | None:
    """Return the rotation (3, 3) of the rig frame that puts the plane of a path into the x-y plane of the base.

    None where the path (K poses) shows no plane, or one that is too far from the base's.
    """
    T_odom_rig = se3.inverse(T_rig_odom)
    positions = T_odom_rig[:, :3, 3]
    _, sizes, axes = np.linalg.svd(positions - positions.mean(axis=0))
    sizes = sizes / np.sqrt(len(positions))
    if 2 * sizes[1] < MIN_EXTENT_M or sizes[2] > MAX_ROUGHNESS * sizes[1]:
        return None
    normal = (T_rig_odom[:, :3, :3] @ axes[2]).mean(axis=0)
    R_base_rig = rig.T_base_rig[:3, :3]
    up = R_base_rig @ normal / np.linalg.norm(normal)
    up = up * np.sign(up[2])
    axis = np.cross(up, [0.0, 0.0, 1.0])
    angle = float(np.arctan2(np.linalg.norm(axis), up[2]))
    if angle > MAX_LEVEL_RAD:
        return None
    turn = se3.rotation_exp(axis * (angle / max(np.linalg.norm(axis), np.finfo(float).tiny)))
    return np.asarray(R_base_rig.T @ turn @ R_base_rig)


def turned_about_lower(rig: Rig, R: Array) -> Rig:
    """Return the rig with both cameras rotated by R (3, 3) in the rig frame, about the lower viewpoint."""
    T = se3.transform(R, rig.lower.viewpoint - R @ rig.lower.viewpoint)
    lower, upper = (replace(m, T_cam_rig=m.T_cam_rig @ se3.inverse(T)) for m in (rig.lower, rig.upper))
    return replace(rig, lower=lower, upper=upper)
