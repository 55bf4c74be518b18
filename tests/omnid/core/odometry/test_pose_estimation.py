"""Motions from landmarks and views: the closed form, RANSAC with outliers, Gauss-Newton and its covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.pose_estimation import gauss_newton, ransac
from omnid.core.stereo.triangulation import point_covariance, view
from omnid.core.types.stereo_model import StereoModel
from tests.omnid.core.scenery import motion_errors

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


def test_ransac_finds_the_motion_among_outliers() -> None:
    points = landmarks(200)
    views = views_of(points) + np.random.default_rng(2).normal(0, 0.1, (200, 3))
    outliers = np.arange(200) % 5 < 3
    views[outliers] = views_of(landmarks(120, 5), np.eye(4))
    T, agree = ransac(points, views, MODEL, np.random.default_rng(3))
    assert not agree[outliers].sum() > 3
    assert agree[~outliers].sum() > 70
    distance, angle = motion_errors(T, MOTION)
    assert distance < 0.03 and angle < 0.02


def test_the_covariance_matches_the_scatter() -> None:
    """Every direction of the six, landmarks and views both noisy, within 30 % of the standard deviation."""
    points, rng = landmarks(60), np.random.default_rng(7)
    covariance = point_covariance(points, MODEL.cylinder, MODEL.baseline_m, MODEL.sigma_px)
    roots, errors, reported = np.linalg.cholesky(covariance), [], []
    for _ in range(300):
        noisy = points + (roots @ rng.standard_normal((60, 3, 1)))[:, :, 0]
        views = views_of(points) + MODEL.sigma_px * rng.standard_normal((60, 3))
        estimate = gauss_newton(noisy, covariance, views, MOTION, MODEL)
        errors.append(se3.log(estimate.T @ se3.inverse(MOTION)))
        reported.append(estimate.covariance)
    W = np.linalg.inv(np.linalg.cholesky(np.mean(reported, axis=0)))
    spread = np.sqrt(np.linalg.eigvalsh(W @ np.cov(np.array(errors).T) @ W.T))
    assert spread.min() > 0.7 and spread.max() < 1.3
