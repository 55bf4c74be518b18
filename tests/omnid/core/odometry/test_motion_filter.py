"""The Kalman filter of velocity and acceleration."""

from __future__ import annotations

import numpy as np

from calib import se3
from omnid.core.odometry.motion_filter import MotionFilter

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
