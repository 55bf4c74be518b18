"""Prediction of the velocity during the exposures: smooth motion is extrapolated, vibration is not."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from calib import se3
from omnid.core.odometry.exposure_velocity import ExposureVelocity
from omnid.core.odometry.motion_filter import MotionFilter

DT_S = 0.08
NOISE = np.diag([1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5]) ** 2


def driven(pairs: int, heave_m: float, tilt_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N, 6) of the predictions after each step, and their sigmas: a vehicle that speeds up and vibrates."""
    rng = np.random.default_rng(5)
    time_s = DT_S * np.arange(pairs + 1)
    shaken = rng.standard_normal((pairs + 1, 3)) * [heave_m, tilt_rad, tilt_rad]
    poses = [
        se3.transform(se3.rotation_exp(np.array([x, y, 0])), np.array([0.2 * t + 0.02 * t**2, 0, z]))
        for t, (z, x, y) in zip(time_s, shaken, strict=True)
    ]
    steps = [se3.inverse(a) @ b for a, b in pairwise(poses)]
    motion_filter, errors, sigmas = MotionFilter(), [], []
    velocity = ExposureVelocity(motion_filter)
    for k, step in enumerate(steps[:-1]):
        motion_filter.predict(DT_S)
        found = velocity.after(step, NOISE, DT_S)
        motion_filter.update(step, NOISE, DT_S)
        velocity.accept(step, NOISE, DT_S)
        errors.append(found.twist - (se3.log(step) + se3.log(steps[k + 1])) / (2 * DT_S))
        sigmas.append(np.sqrt(np.diag(found.covariance)))
    return np.array(errors)[10:], np.array(sigmas)[10:]


def test_vibration_is_predicted_by_its_mean_and_the_drive_by_the_filter() -> None:
    errors, sigmas = driven(80, heave_m=1e-3, tilt_rad=3e-3)
    rms = np.sqrt((errors**2).mean(axis=0))
    assert rms[0] < 0.01 and (rms[[2]] < 0.015).all() and (rms[3:5] < 0.04).all()
    z = np.sqrt(((errors / sigmas) ** 2).mean(axis=0))
    assert ((z[2:5] > 0.6) & (z[2:5] < 1.5)).all()  # a standard deviation that is that of the errors


def test_a_smooth_drive_is_extrapolated() -> None:
    errors, _ = driven(60, heave_m=0.0, tilt_rad=0.0)
    assert np.abs(errors).max() < 1e-3  # the mean of twelve steps would lag by 0.02 m/s


def test_reset_forgets_the_mean() -> None:
    motion_filter = MotionFilter()
    velocity = ExposureVelocity(motion_filter)
    for _ in range(12):
        motion_filter.predict(DT_S)
        step = se3.exp([0.05, 0, 0, 0, 0, 0])
        motion_filter.update(step, NOISE, DT_S)
        velocity.accept(step, NOISE, DT_S)
    motion_filter.reset()
    velocity.reset()
    np.testing.assert_array_equal(velocity.predicted(DT_S).twist, 0)


def test_the_step_after_a_pair_shows_its_velocity() -> None:
    """A motion that changes evenly is exact there, also where the steps take different times."""
    motion_filter = MotionFilter()
    velocity, times_s = ExposureVelocity(motion_filter), np.array([0.0, 0.08, 0.16, 0.28])
    x, shaken = 0.5 * times_s + 0.8 * times_s**2, np.array([0.0, 1e-3, -1e-3, 1e-3])
    found = []
    for k, dt_s in enumerate(np.diff(times_s)):
        step = se3.exp([x[k + 1] - x[k], 0, shaken[k + 1] - shaken[k], 0, 0, 0])
        motion_filter.predict(dt_s)
        motion_filter.update(step, NOISE, dt_s)
        found.append(velocity.accept(step, NOISE, dt_s))
    assert found[0] is None
    for at, time_s in zip(found[1:], times_s[1:-1], strict=True):
        assert at is not None and at.twist[0] == pytest.approx(0.5 + 1.6 * time_s, abs=1e-9)
        sigma = np.sqrt(np.diag(at.covariance))
        assert 1e-3 < sigma[0] < 0.1 and sigma[2] > 0.01, "what shakes is known less well"
    velocity.reset()
    assert velocity.accept(step, NOISE, 0.08) is None, "after a break no step is before it"
