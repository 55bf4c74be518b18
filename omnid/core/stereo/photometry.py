"""Brightness and noise of panoramas: dim images are made brighter, and the noise is measured, which sets thresholds.

Two images are only compared at the same brightness. The exposure of a camera changes from image to image and differs
between the two cameras; in the dark both are dim. So an image below a level is multiplied up to it, and the dimmer one
of a pair up to the other one where they clearly differ. What is left of gain and offset,
`core/odometry/plane_patches.py` finds for each patch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.stereo.tiles import MEASURED_NOISE_GREY, TileSums

Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]

TARGET_LEVEL = 80.0  # grey levels: mean to which dimmer panoramas are brought.
MIN_CONTRAST_TO_NOISE = 1.0  # because below it there is more noise than scene; below half of it corners are noise
# Brightness of one panorama by the other's, above which nothing is changed: at 0.88 poses are as exact as at 1, at 0.85
# they were degraded, at 0.8 lost.
SAME_BRIGHTNESS = 0.87
# Share of the columns of tiles that must differ, because a hand before one camera does not cover so many.
DIFFERING = 0.75
MAX_GAIN = 8.0  # Largest gain of 8 bit images, because more only magnifies their steps.
# Noise is the difference of two Gaussian blurs in the smoothest blocks, because texture is stronger than noise
# elsewhere.
FINE_PX, COARSE_PX = 0.8, 1.6
BLOCK_PX = 8
SMOOTHEST_PERCENT = 5.0
# Noise of a panorama by that measure; measured with simulated white noise of 1.5 to 13 grey levels, JPEG, remapped
# bilinearly.
NOISE_SCALE = 6.1
BANDS, BAND_ROWS = 4, 24  # rows in which noise is measured: all would take milliseconds


@dataclass(frozen=True, slots=True)
class Light:
    """Brightness of a pair, of the dimmer camera, before any gain."""

    level_grey: float = math.nan  # mean
    contrast_to_noise: float = math.inf  # standard deviations

    @property
    def is_too_dark(self) -> bool:
        """True if a dim image has more noise than contrast: poses are then not to be relied on."""
        return self.level_grey < TARGET_LEVEL and self.contrast_to_noise < MIN_CONTRAST_TO_NOISE

    @property
    def is_noise(self) -> bool:
        """True if the corners of a dim image are noise, so that a map of them would be wrong."""
        return self.level_grey < TARGET_LEVEL and self.contrast_to_noise < MIN_CONTRAST_TO_NOISE / 2


def light(sums: TileSums, noise_grey: float) -> Light:
    """Return the light of a panorama by the sums over its tiles, with noise of noise_grey."""
    pixels = max(1, int(sums.pixels.sum()))
    mean, square = (float(total.sum(dtype=np.int64)) / pixels for total in (sums.grey, sums.square))
    contrast = math.sqrt(max(0.0, square - mean**2 - noise_grey**2))
    return Light(mean, contrast / max(noise_grey, MEASURED_NOISE_GREY))


def gain_of(level: float) -> float:
    """Return the factor that brings a panorama of that mean level to TARGET_LEVEL; 1 for a brighter one."""
    return float(np.clip(TARGET_LEVEL / max(level, 1.0), 1.0, MAX_GAIN))


def pair_gains(lower: TileSums, upper: TileSums, gains: tuple[float, float]) -> tuple[float, float]:
    """Return gains of both panoramas, given by the sums over their tiles, with which they are about as bright.

    gains: those by their levels, which stay unless the panoramas clearly differ.
    """
    of_lower, of_upper = (gain * sums.grey.sum(axis=0) for sums, gain in zip((lower, upper), gains, strict=True))
    known = (of_lower > 0) & (of_upper > 0)
    ratios = of_lower[known] / of_upper[known]
    if not len(ratios):
        return gains
    least, ratio, most = np.quantile(ratios, [1 - DIFFERING, 0.5, DIFFERING]).tolist()
    if most >= SAME_BRIGHTNESS and least <= 1 / SAME_BRIGHTNESS:
        return gains
    return min(MAX_GAIN, gains[0] / min(1.0, ratio)), min(MAX_GAIN, gains[1] * max(1.0, ratio))


def brightened(panorama: Image, gain: float) -> Image:
    """Return the panorama multiplied by a gain; values above 255 are cut."""
    return panorama if gain == 1.0 else np.asarray(cv2.convertScaleAbs(panorama, alpha=gain), np.uint8)


def noise_sigma(panorama: Image, visible: Flags) -> float:
    """Return the standard deviation of the noise [grey levels] of a panorama (H, W) where it is visible (H, W).

    MEASURED_NOISE_GREY where no block is visible.
    """
    means = []
    for top in np.linspace(0, max(0, len(panorama) - BAND_ROWS), BANDS).astype(int).tolist():
        band = panorama[top : top + BAND_ROWS].astype(np.float32)
        difference = cv2.GaussianBlur(band, (0, 0), FINE_PX) - cv2.GaussianBlur(band, (0, 0), COARSE_PX)
        shown = visible[top : top + BAND_ROWS].astype(np.float32)
        magnitude, share = (block_means(image, BLOCK_PX) for image in (np.abs(difference), shown))
        means.append(magnitude[share == 1])
    found = np.concatenate(means)
    return NOISE_SCALE * float(np.percentile(found, SMOOTHEST_PERCENT)) if len(found) else MEASURED_NOISE_GREY


def block_means(image: NDArray[Any], side_px: int) -> NDArray[Any]:
    """Return the means (H / side, W / side) of the whole square blocks of an image (H, W), in its type."""
    rows, columns = image.shape[0] // side_px, image.shape[1] // side_px
    whole = image[: rows * side_px, : columns * side_px]
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA))
