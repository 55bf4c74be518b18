"""Covariance with a misfit: none for pure noise, and honest where a smooth error is absorbed by the parameters."""

from __future__ import annotations

import numpy as np

from calib.fit.boards.smooth_misfit import covariance_with_misfit, smooth_fields

SIGMA, COUNT = 0.02, 600


def fitted(rng: np.random.Generator, tau: float) -> tuple[np.ndarray, np.ndarray]:
    """Fit a plane to values with a smooth error; return the errors of its parameters and their covariance."""
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
    return found, covariance_with_misfit(both.T @ both, both.T @ left, 4, variance)


def test_errors_agree_with_the_covariance_with_and_without_a_misfit() -> None:
    rng = np.random.default_rng(1)
    for tau in (0.0, 0.01):
        trials = [fitted(rng, tau) for _ in range(60)]
        squares = [float(error @ np.linalg.solve(covariance, error)) / 4 for error, covariance in trials]
        assert 0.5 < np.mean(squares) < 1.6, "a little too large without a misfit, which is not known to be none"


def test_unknown_pixels_have_no_fields() -> None:
    pixels = np.random.default_rng(2).uniform(0, 300, (3, 10, 2))
    pixels[1, 7] = np.nan
    fields = smooth_fields(pixels, 2)
    assert fields.shape[:3] == (3, 10, 2) and not fields[1, 7].any() and fields[1, 6].any()
    half = fields.shape[3] // 2
    assert not fields[:, :5, :, half:].any() and not fields[:, 5:, :, :half].any(), "each camera has its own"


def test_fields_have_no_swirl() -> None:
    """A camera's turn about its axis is no error of a surface: the fields of a full ring add up to none."""
    angle = 2 * np.pi * np.arange(360) / 360
    along = np.column_stack([np.cos(angle), np.sin(angle)])
    disc = np.concatenate([radius * along for radius in (40.0, 90.0, 140.0)])[None] + 200
    fields = smooth_fields(disc, 1)[0]
    tangential = np.einsum("ni,nif->nf", np.tile(np.column_stack([-along[:, 1], along[:, 0]]), (3, 1)), fields)
    for ring in np.split(tangential, 3):
        assert np.abs(ring.mean(axis=0)).max() < 1e-9 < np.abs(ring).max()


def test_a_fit_whose_parameters_explain_all_fields_has_no_misfit() -> None:
    J = np.random.default_rng(3).normal(size=(50, 4))
    both = np.column_stack([J, J])
    covariance = covariance_with_misfit(both.T @ both, np.zeros(8), 4, 0.01)
    assert np.allclose(covariance, 0.01 * np.linalg.inv(J.T @ J))
