"""The Kalman filter of velocity and acceleration."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.core.odometry.motion_filter import MotionFilter
from tests.omnid.core.scenery import motion_errors

TWIST = np.array([0.5, -0.1, 0.02, 0.05, -0.03, 0.8])  # m/s, rad/s
NOISE = np.diag(np.repeat([0.002, 0.001], 3) ** 2)  # of a motion, m^2 and rad^2


def test_constant_velocity_is_estimated_and_smoothed_with_irregular_steps() -> None:
    motion, rng = MotionFilter(), np.random.default_rng(1)
    raw, filtered = [], []
    for _ in range(60):
        dt_s = float(rng.choice([0.03, 0.1, 0.2]))
        noise = rng.multivariate_normal(np.zeros(6), NOISE)
        motion.predict(dt_s)
        motion.update(se3.exp(TWIST * dt_s) @ se3.exp(noise), NOISE, dt_s)
        raw.append(np.abs(noise) / dt_s)
        filtered.append(np.abs(motion.velocity - TWIST))
    assert (np.mean(filtered[20:], axis=0) < 0.9 * np.mean(raw[20:], axis=0)).all()
    np.testing.assert_allclose(motion.velocity, TWIST, atol=0.05)


def test_the_prediction_is_the_motion_in_that_time() -> None:
    motion = MotionFilter()
    for _ in range(30):
        motion.predict(0.1)
        motion.update(se3.exp(TWIST * 0.1), NOISE * 1e-4, 0.1)
    for dt_s in (0.05, 0.3):
        distance, angle = motion_errors(motion.predict(dt_s), se3.exp(TWIST * dt_s))
        assert distance < 2e-3 * dt_s / 0.05 and angle < 2e-3 * dt_s / 0.05


def test_acceleration_is_predicted() -> None:
    motion = MotionFilter()
    for k in range(40):
        motion.predict(0.1)
        motion.update(se3.exp([0.1 * (0.2 * k * 0.1), 0, 0, 0, 0, 0]), NOISE * 1e-4, 0.1)
    assert se3.log(motion.predict(0.1))[0] == pytest.approx(0.1 * 0.2 * 40 * 0.1, rel=0.02)


def test_follows_a_jump_within_the_process_noise_at_once() -> None:
    motion = MotionFilter()
    motion.predict(0.1)
    T = motion.update(se3.exp([0.05, 0, 0, 0, 0, 1.6]), NOISE, 0.1)
    assert motion_errors(T, se3.exp([0.05, 0, 0, 0, 0, 1.6]))[1] < 0.01


def test_the_covariance_is_symmetric_positive_and_shrinks_with_measurements() -> None:
    motion = MotionFilter()
    before = motion.velocity_covariance
    coupled = NOISE.copy()
    coupled[0, 4] = coupled[4, 0] = 1.5e-6
    for _ in range(200):
        motion.predict(0.1)
        motion.update(se3.exp(TWIST * 0.1), coupled, 0.1)
    P = motion.velocity_covariance
    np.testing.assert_array_equal(P, P.T)
    assert np.linalg.eigvalsh(P).min() > 0
    assert (np.diag(P) < np.diag(before)).all() and (np.diag(P) < 1.01 * np.diag(NOISE) / 0.1**2).all()
    motion.predict(1.0)
    assert (np.diag(motion.velocity_covariance) > 10 * np.diag(P)).all()


def test_slows_down_and_resets() -> None:
    motion = MotionFilter()
    for _ in range(20):
        motion.predict(0.1)
        motion.update(se3.exp(TWIST * 0.1), NOISE * 1e-4, 0.1)
    speed = motion.velocity
    motion.slow_down(0.5)
    np.testing.assert_allclose(motion.velocity, speed / 2)
    motion.reset()
    np.testing.assert_array_equal(motion.velocity, np.zeros(6))
    assert motion.velocity_covariance[0, 0] == pytest.approx(1.0)
