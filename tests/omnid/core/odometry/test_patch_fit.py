"""Shift, gain and offset between patches, and the covariance of the shift."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.plane_patches import TEMPLATE_PX, AlignedPatches, align
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
SHIFT = np.array([0.7, -0.45])  # of the current patches, px
REACH_PX = 2
CELL_PX = TEMPLATE_PX + 2 * REACH_PX
CENTRES = CELL_PX * np.array([(column, row) for row in range(20) for column in range(20)]) + CELL_PX // 2.0


def patches(
    count: int, shift: Array, *, gain: float = 1.0, offset: float = 0.0, contrast: float = 30.0, noise: float = 0.0
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return templates (N, CELL, CELL) of a random texture, and cells in which it lies at a shift."""
    rng = np.random.default_rng(4)
    side = CELL_PX + 16
    spectrum = np.fft.rfft2(rng.standard_normal((count, side, side)))
    fy, fx = np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None]
    spectrum *= np.exp(-2 * (np.pi * 2.0) ** 2 * (fx**2 + fy**2))  # a blur of 2 px
    moved = spectrum * np.exp(-2j * np.pi * (fx * shift[0] + fy * shift[1]))
    both = [np.fft.irfft2(s, (side, side))[:, 8:-8, 8:-8] for s in (spectrum, moved)]
    scale = contrast / both[0].std()
    images = 120 + scale * both[0], gain * (120 + scale * both[1]) + offset
    noisy = [image + noise * rng.standard_normal(image.shape) for image in images]
    templates, cells = (np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in noisy)
    return templates, cells


def fitted(templates: NDArray[np.uint8], cells: NDArray[np.uint8], noise_grey: float = 1.0) -> AlignedPatches:
    """Align the middles of 400 templates with a panorama of 20 by 20 cells."""
    image = cells.reshape(20, 20, CELL_PX, CELL_PX).swapaxes(1, 2).reshape(20 * CELL_PX, 20 * CELL_PX)
    middle = np.ascontiguousarray(templates[:, REACH_PX:-REACH_PX, REACH_PX:-REACH_PX], np.float32) - 128
    panorama = PaddedPanorama(np.ascontiguousarray(image), 0, noise_grey)
    return align(middle, panorama, CENTRES, REACH_PX)


def error(fit: AlignedPatches) -> Array:
    return (fit.pixels - CENTRES)[fit.found] - SHIFT


def test_a_shift_is_found_to_hundredths_under_another_gain_and_offset() -> None:
    for gain, offset in ((1.0, 0.0), (0.7, 10.0), (1.3, -30.0)):
        fit = fitted(*patches(400, SHIFT, gain=gain, offset=offset))
        assert fit.found.mean() > 0.95
        assert np.sqrt((error(fit) ** 2).mean()) < 0.02
        assert np.abs(error(fit).mean(axis=0)).max() < 0.01


def test_the_covariance_is_that_of_the_errors() -> None:
    """Pixels of a panorama have correlated noise: NOISE_CORRELATION times the variance of independent ones."""
    rng = np.random.default_rng(9)
    templates, cells = patches(400, SHIFT, contrast=15.0)
    for sigma in (3.0, 9.0):
        noise = rng.standard_normal((2, 400, CELL_PX + 8, CELL_PX + 8)).astype(np.float32)
        smooth = np.array([[cv2.GaussianBlur(cell, (0, 0), 0.5) for cell in image] for image in noise])
        smooth = smooth[:, :, 4:-4, 4:-4] * sigma / smooth.std()
        noisy = [
            np.clip(np.rint(image + n), 0, 255).astype(np.uint8)
            for image, n in zip((templates, cells), smooth, strict=True)
        ]
        fit = fitted(noisy[0], noisy[1], sigma)
        squared = np.einsum("ni,nij,nj->n", error(fit), np.linalg.inv(fit.covariance[fit.found]), error(fit))
        assert fit.found.mean() > 0.8
        assert 0.5 < np.sqrt(np.median(squared) / 1.386) < 1.5  # the median of chi^2 with two degrees is 1.386
