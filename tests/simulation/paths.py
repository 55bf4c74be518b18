"""Seeded paths of the rig: poses T_world_rig (N, 4, 4), x forward, camera height 1.2 m."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from calib import se3
from calib.models.camera import Array

HEIGHT_M = 1.2


def planar_poses(xy_m: Array, heading_rad: Array) -> Array:
    """Return poses (N, 4, 4) of an upright rig at xy_m (N, 2) with heading_rad (N,)."""
    zero = np.zeros(len(xy_m))
    R = se3.rotation_exp(np.column_stack([zero, zero, heading_rad]))
    return se3.transform(R, np.column_stack([xy_m, zero + HEIGHT_M]))


def spline_path(
    seed: int, pairs: int, step_m: float, *, sway_m: float = 0.3, turn: tuple[int, float] | None = None
) -> Array:
    """Return a swaying path along +x from the origin, step_m of arc between pairs, heading along the path.

    turn = (pair, degrees): from that pair on the rig is rotated to the left, after half a step of motion.
    """
    rng = np.random.default_rng([seed, 3])
    knots = int(pairs * step_m) + 4
    y = np.concatenate([[0], rng.uniform(-sway_m, sway_m, knots - 1)])
    x = np.linspace(0, knots - 1.001, 200 * knots)
    spline = CubicSpline(np.arange(knots), y, bc_type="natural")
    lateral, slope = spline(x), spline(x, 1)
    arc = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(lateral)))])
    wanted = step_m * np.arange(pairs)
    if turn is not None:
        wanted[turn[0] :] -= step_m / 2
    heading = np.interp(wanted, arc, np.arctan(slope))
    if turn is not None:
        heading[turn[0] :] += np.deg2rad(turn[1])
    return planar_poses(np.column_stack([np.interp(wanted, arc, x), np.interp(wanted, arc, lateral)]), heading)


def turns(angles_deg: list[float], step_m: float = 0.03) -> Array:
    """Return len + 1 poses: between two pairs the rig rotates by an angle and moves step_m ahead."""
    heading = np.deg2rad(np.concatenate([[0], np.cumsum(angles_deg)]))
    moves = step_m * np.column_stack([np.cos(heading[:-1]), np.sin(heading[:-1])])
    return planar_poses(np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)]), heading)


def back_again(poses: Array) -> Array:
    """Return the path forwards and then backwards over the same poses, 2 N - 1 of them."""
    return np.concatenate([poses, poses[-2::-1]])


def loop(seed: int, pairs: int, radius_m: float = 0.9) -> Array:
    """Return a closed, uneven loop about the origin with changing speed, heading along the path."""
    rng = np.random.default_rng([seed, 4])
    phases = rng.uniform(0, 2 * np.pi, 3)

    def place(t: Array) -> Array:
        radius = radius_m * (1 + 0.12 * np.sin(2 * t + phases[0]) + 0.06 * np.sin(3 * t + phases[1]))
        return np.column_stack([radius * np.cos(t), radius * np.sin(t)])

    t = np.linspace(0, 2 * np.pi, pairs)
    t = t + 0.35 * np.sin(t + phases[2])
    ahead = place(t + 1e-5) - place(t - 1e-5)
    return planar_poses(place(t), np.arctan2(ahead[:, 1], ahead[:, 0]))


def vibrate(poses: Array, seed: int, tilt_deg: float = 0.3, shake_mm: float = 1.0) -> Array:
    """Return the poses on an uneven floor: roll and pitch (standard deviation tilt_deg), height (shake_mm)."""
    rng = np.random.default_rng([seed, 5])
    tilt = np.deg2rad(tilt_deg) * rng.standard_normal((len(poses), 2))
    lift = 1e-3 * shake_mm * rng.standard_normal(len(poses))
    zero = np.zeros(len(poses))
    small = se3.transform(se3.rotation_exp(np.column_stack([tilt, zero])), np.column_stack([zero, zero, lift]))
    return np.asarray(poses @ small)
