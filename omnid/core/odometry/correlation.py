"""Normalised correlation of the windows of two panoramas (NCC), which gain and offset do not change."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Image = NDArray[np.uint8]

MOST_ROWS = 32_000  # of a map that OpenCV takes


def normalised_patches(
    panorama: PaddedPanorama, pixels: Array, side: int, step_px: int = 1, image: Floats | None = None
) -> tuple[Floats, Floats]:
    """Return patches (N, side^2) of zero mean and unit length about pixels (N, 2), and their standard deviations (N,).

    Greys between pixels are interpolated; beyond the image its border is repeated. step_px: between two samples. image:
    a padded one that is sampled in place of the panorama's. The product of two patches is their correlation.
    """
    source = (panorama.image if image is None else image).astype(np.float32, copy=False)
    offsets = ((np.arange(side) - side // 2) * step_px).astype(np.float32)
    across, down = panorama.padded(pixels[:, 0]).astype(np.float32), pixels[:, 1].astype(np.float32)
    patches = np.empty((len(pixels), side * side), np.float32)
    for first in range(0, len(pixels), MOST_ROWS):
        part = slice(first, first + MOST_ROWS)
        columns = across[part, None] + np.tile(offsets, side)
        rows = down[part, None] + np.repeat(offsets, side)
        patches[part] = cv2.remap(source, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    patches -= patches.mean(axis=1, keepdims=True)
    length = np.linalg.norm(patches, axis=1)
    # A patch without contrast divides by no zero.
    return patches / np.maximum(length, 1e-9)[:, None], length / side
