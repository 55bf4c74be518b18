"""Motions from landmarks and views, views at other times of exposure, and the errors of a rig in a covariance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.fit import rig_uncertainty
from calib.panorama import Cylinder
from calib.rig import Rig, RigCovariance
from omnid.core.odometry.exposure_times import Exposure, RigVelocity
from omnid.core.odometry.pose_estimation import gauss_newton, ransac
from omnid.core.odometry.rig_error import RigError
from omnid.core.stereo.triangulation import point_covariance, view
from omnid.core.types.pixel_times import PixelTimes
from omnid.core.types.stereo_model import StereoModel
from tests.simulation.rigs import make_rig

Array = NDArray[np.float64]

MODEL = StereoModel(Cylinder(1304, 383, 128.5), 0.2, sigma_px=0.2)
MOTION = se3.exp([0.08, -0.05, 0.02, 0.01, -0.02, 0.9])  # T_curr_ref


def landmarks(count: int, seed: int = 0) -> Array:
    """Points (N, 3) [m] on all sides."""
    rng = np.random.default_rng(seed)
    azimuth, r = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.8, 3, count)
    return np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), rng.uniform(-1, 1, count)])


def views_of(points: Array, T: Array = MOTION) -> Array:
    """Their exact views (N, 3) after the motion."""
    return view(se3.apply(T, points), MODEL.cylinder, MODEL.baseline_m)


@pytest.mark.parametrize("noise", [0.4, 1.0, 1.5])
def test_the_covariance_matches_the_scatter(noise: float) -> None:
    """In every direction of the six within 30 % of the standard deviation; noise: by the expected one."""
    points, rng = landmarks(60), np.random.default_rng(7)
    covariance = point_covariance(points, MODEL.cylinder, MODEL.baseline_m, MODEL.sigma_px)
    roots, errors, reported = np.linalg.cholesky(covariance), [], []
    for _ in range(300):
        noisy = points + noise * (roots @ rng.standard_normal((60, 3, 1)))[:, :, 0]
        views = views_of(points) + noise * MODEL.sigma_px * rng.standard_normal((60, 3))
        estimate = gauss_newton(noisy, covariance, views, MOTION, MODEL)
        errors.append(se3.log(estimate.T @ se3.inverse(MOTION)))
        reported.append(estimate.covariance)
    W = np.linalg.inv(np.linalg.cholesky(np.mean(reported, axis=0)))
    spread = np.sqrt(np.linalg.eigvalsh(W @ np.cov(np.array(errors).T) @ W.T))
    assert spread.min() > 0.7 and spread.max() < 1.3


@pytest.mark.parametrize("right", [0, 1, 2])
def test_views_that_agree_with_no_motion_give_none_and_no_error(right: int) -> None:
    """Where all but so few of the views are outliers the equations have no other solution."""
    points, rng = landmarks(30), np.random.default_rng(5)
    covariance = point_covariance(points, MODEL.cylinder, MODEL.baseline_m, MODEL.sigma_px)
    views = views_of(points)
    views[right:] += rng.choice([-1, 1], (30 - right, 3)) * rng.uniform(30, 60, (30 - right, 3))
    found = gauss_newton(points, 1e-6 * covariance, views, MOTION, replace(MODEL, sigma_px=0.02))
    assert np.isfinite(found.covariance).all() and (found.squared < 16).sum() < 6


def test_a_few_near_landmarks_tell_a_step_aside_from_a_turn() -> None:
    """As before a wall, where the others agree with both, and with no motion as well, within the noise of tracks."""
    rng = np.random.default_rng(1)
    far_m = np.repeat([6.0, 2.0], [90, 10])[:, None]
    points = far_m * np.column_stack([np.ones(100), rng.uniform(-0.25, 0.25, (100, 2))])
    step = se3.exp([0.0, 0.03, 0.0, 0.0, 0.0, 0.0])
    T, agree = ransac(points, views_of(points, step), MODEL, rng)
    assert agree.all() and np.abs(T - step).max() < 1e-6


BASELINE_M, SCALE = 0.2, 0.01


def rig(sigma_m: float) -> Rig:
    covariance = RigCovariance(("baseline",), np.array([sigma_m]), np.eye(1))
    return replace(make_rig(baseline_m=BASELINE_M), covariance=covariance)


def poses(*xy: tuple[float, float]) -> list[se3.Array]:
    return [se3.transform(se3.rotation_exp([0.0, 0.0, 0.3 * k]), [x, y, 0.0]) for k, (x, y) in enumerate(xy)]


def test_a_scale_is_one_error_along_the_path() -> None:
    """G = p: the error of the position is the scale times the position, whatever the way, its turns and steps."""
    error = RigError(rig_uncertainty.motion_errors(rig(SCALE * BASELINE_M)))
    for T in poses((0.1, 0), (1, 0), (2, 1), (2, 2), (1, 3)):
        covariance = error.at(T, 2.0)
        in_odom = T[:3, :3] @ covariance[:3, :3] @ T[:3, :3].T
        p = T[:3, 3]
        assert in_odom == pytest.approx(SCALE**2 * np.outer(p, p), abs=0.03 * SCALE**2 * float(p @ p))


def test_a_way_back_takes_off_what_the_way_there_has_added() -> None:
    error = RigError(rig_uncertainty.motion_errors(replace(make_rig(), covariance=None)))
    there = math.sqrt(np.trace(error.at(se3.transform(np.eye(3), [3.0, 0.0, 0.0]), 2.0)[:3, :3]))
    back = math.sqrt(np.trace(error.at(np.eye(4), 2.0)[:3, :3]))
    # A file without a covariance may be wrong by 0.2 % of scale and 0.05 degree.
    assert there > 0.002 * 3.0 and back < 1e-3 * there


LARGE = StereoModel(Cylinder(1200, 360, 130.0), 0.2)
TWIST = np.array([0.7, -0.1, 0.05, 0.05, -0.1, 0.8])  # 0.7 m/s and 45 degrees/s
SIGMA = np.diag([0.1, 0.1, 0.1, 0.2, 0.2, 0.2])


def surroundings(count: int = 300) -> Array:
    """Points (N, 3) of walls, floor and ceiling around the rig."""
    rng = np.random.default_rng(3)
    azimuth, r = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.8, 5.0, count)
    return np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), r * rng.uniform(-0.6, 0.4, count)])


def rolling(line_s: float) -> NDArray[np.float32]:
    """Times (H, W) of a camera whose image rows run across the panorama."""
    rows, columns = np.mgrid[: LARGE.cylinder.height, : LARGE.cylinder.width]
    image_rows = 380 - (100 + 0.5 * rows) * np.cos(columns / LARGE.cylinder.focal_px)
    return (line_s * image_rows).astype(np.float32)


TIMES = [
    PixelTimes(0.015),
    PixelTimes(-0.02),
    PixelTimes(0.0, rolling(26e-6), rolling(26e-6)),
    PixelTimes(0.01, rolling(26e-6), rolling(20e-6)),
]


def seen(points: Array, times: PixelTimes, twist: Array) -> tuple[Array, Array]:
    """Pixels (N, 2) in both panoramas of points (N, 3), each projected at its own time of exposure."""
    pixels = []
    for camera in (0, 1):
        at = view(points, LARGE.cylinder, LARGE.baseline_m)[:, [0, 1 + camera]]
        for _ in range(4):  # the time depends on the pixel
            tau = (times.upper if camera else times.lower)(at)
            moved = np.concatenate([se3.apply(se3.exp(-twist * t), p[None]) for t, p in zip(tau, points, strict=True)])
            at = view(moved, LARGE.cylinder, LARGE.baseline_m)[:, [0, 1 + camera]]
        pixels.append(at)
    return pixels[0], pixels[1]


@pytest.mark.parametrize("times", TIMES)
def test_views_are_corrected_to_the_instant_of_the_stamp(times: PixelTimes) -> None:
    points = surroundings()
    truth = view(points, LARGE.cylinder, LARGE.baseline_m)
    lower, upper = seen(points, times, TWIST)
    exposure = Exposure(times, RigVelocity(TWIST, SIGMA**2), LARGE)
    shift = exposure.shift(points)
    for raw, moved, expected in (
        (lower, shift.px[:, :2], truth[:, :2]),
        (upper, shift.px[:, [3, 2]], truth[:, [0, 2]]),
    ):
        error = expected - raw - moved
        error[:, 0] = LARGE.cylinder.wrap(error[:, 0])
        assert np.abs(error).max() < 0.05  # the time is that of the nearest pixel
    assert np.abs(shift.px).max() > 1.0, "the motion matters"
    # Without the points: from the pixels and rows that are measured.
    views, found = exposure.corrected(lower, upper[:, 1])
    error = views - truth
    error[:, 0] = LARGE.cylinder.wrap(error[:, 0])
    assert np.abs(error).max() < 0.05
    off_px = LARGE.cylinder.wrap(views[:, 0] - found.px[:, 3] - upper[:, 0])
    assert np.abs(off_px).max() < 0.05 and (found.spread_px > 0).all()
