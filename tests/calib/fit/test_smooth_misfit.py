"""Covariance with a misfit: none for pure noise, and honest where a smooth error is absorbed by the parameters."""

from __future__ import annotations

import numpy as np

from calib.fit.smooth_misfit import covariance_with_misfit, smooth_fields

SIGMA, COUNT = 0.02, 600


def fitted(rng: np.random.Generator, tau: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Fit a plane to values with a smooth error; return parameters' errors, covariance, tau."""
    pixels = rng.uniform(100, 500, (COUNT // 100, 100, 2))
    fields = smooth_fields(pixels, 2)
    rows = fields.reshape(-1, fields.shape[3])
    u, v = ((np.repeat(pixels[..., axis].ravel(), 2) - 300) / 200 for axis in (0, 1))
    in_v = np.tile([0.0, 1.0], COUNT)
    J = np.column_stack([1 - in_v, in_v, u * (1 - in_v), v * in_v])
    error = rng.normal(0, SIGMA, len(J)) + rows @ rng.normal(0, tau, rows.shape[1])
    found = np.linalg.lstsq(J, error, rcond=None)[0]
    both, left = np.column_stack([J, rows]), error - J @ found
    variance = float(left @ left) / (len(J) - 4)
    covariance, size = covariance_with_misfit(both.T @ both, both.T @ left, 4, variance)
    return found, covariance, size


def test_errors_agree_with_the_covariance_with_and_without_a_misfit() -> None:
    rng = np.random.default_rng(1)
    for tau, low, high in ((0.0, 0.0, 0.004), (0.01, 0.005, 0.02)):
        trials = [fitted(rng, tau) for _ in range(60)]
        squares = [float(error @ np.linalg.solve(covariance, error)) / 4 for error, covariance, _ in trials]
        assert 0.7 < np.mean(squares) < 1.6
        assert low <= np.median([size for _, _, size in trials]) <= high


def test_unknown_pixels_have_no_fields() -> None:
    pixels = np.random.default_rng(2).uniform(0, 300, (3, 10, 2))
    pixels[1, 7] = np.nan
    fields = smooth_fields(pixels, 2)
    assert fields.shape[:3] == (3, 10, 2) and not fields[1, 7].any() and fields[1, 6].any()
    half = fields.shape[3] // 2
    assert not fields[:, :5, :, half:].any() and not fields[:, 5:, :, :half].any(), "each camera has its own"
