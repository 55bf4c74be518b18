"""Seeded paths of the rig: poses T_world_rig (N, 4, 4), x forward, camera height 1.2 m."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from calib import se3
from calib.models.camera import Array
from omnid.simulation.world import clearance_m

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


def still(pairs: int) -> Array:
    """Return poses of a rig that stands at the origin."""
    return planar_poses(np.zeros((pairs, 2)), np.zeros(pairs))


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


def approaches(seed: int, pairs: int, segments: Array, nearest_m: float = 0.3, step_m: float = 0.05) -> Array:
    """Return a path from the origin up to what stands around it, and back in reverse, in one direction after another.

    segments (N, 2, 2): outlines on the floor. The rig drives ahead until its distance to one of them is nearest_m,
    turns by 90 degrees to the side that has more room, and drives on for up to half a metre.
    """
    rng = np.random.default_rng([seed, 9])
    heading = float(rng.uniform(0, 2 * np.pi))
    legs = [np.array([[0.0, 0.0, heading]])]
    while sum(map(len, legs)) < pairs:
        turned = _turned(legs[-1][-1], heading)
        ahead = _driven(turned[-1], 4.0, segments, nearest_m, step_m)
        sides = [_turned(ahead[-1], heading + side * np.pi / 2) for side in (-1, 1)]
        along = max((_driven(side[-1], 0.5, segments, nearest_m, step_m) for side in sides), key=len)
        there = np.concatenate([ahead, _turned(ahead[-1], along[0, 2]), along])
        legs += [turned, there, there[::-1]]
        heading += np.deg2rad(137.5)  # the golden angle: all directions are as far from each other as can be
    places = np.concatenate(legs)[:pairs]
    return planar_poses(places[:, :2], places[:, 2])


def _turned(place: Array, heading_rad: float) -> Array:
    """Return places (N, 3) of a turn on the spot, 10 degrees each, that ends at a heading."""
    turn = (heading_rad - place[2] + np.pi) % (2 * np.pi) - np.pi
    steps = max(1, int(np.ceil(abs(turn) / np.deg2rad(10))))
    return np.column_stack([np.tile(place[:2], (steps, 1)), place[2] + turn * np.arange(1, steps + 1) / steps])


def _driven(place: Array, way_m: float, segments: Array, nearest_m: float, step_m: float) -> Array:
    """Return places (N, 3) straight ahead from a place on, as long as segments (M, 2, 2) are farther than nearest_m."""
    ahead = np.array([np.cos(place[2]), np.sin(place[2]), 0.0])
    places = [place]
    for way in np.arange(step_m, way_m + 1e-9, step_m):
        one = place + way * ahead
        if clearance_m(segments, (float(one[0]), float(one[1])), nearest_m) < 0:
            break
        places.append(one)
    return np.array(places)


def vibrate(poses: Array, seed: int, tilt_deg: float = 0.3, shake_mm: float = 1.0) -> Array:
    """Return the poses on an uneven floor: roll and pitch (standard deviation tilt_deg), height (shake_mm)."""
    rng = np.random.default_rng([seed, 5])
    tilt = np.deg2rad(tilt_deg) * rng.standard_normal((len(poses), 2))
    lift = 1e-3 * shake_mm * rng.standard_normal(len(poses))
    zero = np.zeros(len(poses))
    small = se3.transform(se3.rotation_exp(np.column_stack([tilt, zero])), np.column_stack([zero, zero, lift]))
    return np.asarray(poses @ small)
