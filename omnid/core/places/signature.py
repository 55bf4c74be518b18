"""A small signature of a panorama, by which places are compared at any heading in a fraction of a millisecond."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.types.panorama import PaddedPanorama

ROWS, COLUMNS = 16, 128  # 2 kB a keyframe, 2.8 degrees a column; by trial on development seeds
# Columns, rows: window of the mean that is subtracted, because brightness changes with the light.
SMOOTH: Final = (31, 5)
LEAST_CONTRAST: Final = 4.0  # grey levels: below it there is nothing to compare.
THUMBNAIL_SCALE: Final = 30.0  # Root mean square of a thumbnail's values, so that hardly any exceeds a byte.

Signature = NDArray[np.complex64]
Thumbnail = NDArray[np.int8]


def thumbnail(panorama: PaddedPanorama) -> Thumbnail:
    """Return the panorama (H, W) at (ROWS, COLUMNS) of a full turn without its slow changes of brightness.

    The root mean square is THUMBNAIL_SCALE; zeros for a panorama without contrast, and outside of a sector.
    """
    contrast = _contrast(panorama)
    scaled = np.rint(THUMBNAIL_SCALE * math.sqrt(contrast.size) * contrast)
    return np.asarray(np.clip(scaled, -127, 127), np.int8)


def signature_of(small: Thumbnail) -> Signature:
    """Return the signature of the panorama that has a thumbnail."""
    size = float(np.linalg.norm(small.astype(np.float32)))
    return np.fft.rfft(small / max(size, 1.0), axis=1).astype(np.complex64)


def similarities(a: Signature, others: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Return the largest circular correlations (N,) over all headings with others (N, ROWS, COLUMNS / 2 + 1)."""
    correlation = np.fft.irfft(np.einsum("rk,nrk->nk", a, others.conj()), COLUMNS, axis=1)
    return np.asarray(correlation.max(axis=1), np.float32)


def _contrast(panorama: PaddedPanorama) -> NDArray[np.float32]:
    """Return the panorama at (ROWS, COLUMNS) without slow changes of brightness, of length 1, or zeros."""
    columns = max(1, round(COLUMNS * panorama.width / panorama.period_px))
    small = cv2.resize(panorama.panorama, (columns, ROWS), interpolation=cv2.INTER_AREA).astype(np.float32)
    pad = SMOOTH[0] // 2
    border = cv2.BORDER_WRAP if columns == COLUMNS else cv2.BORDER_REPLICATE
    beside = cv2.copyMakeBorder(small, 0, 0, pad, pad, border)
    contrast = small - cv2.blur(beside, SMOOTH)[:, pad:-pad]
    size = float(np.linalg.norm(contrast))
    whole = np.zeros((ROWS, COLUMNS), np.float32)
    if size < LEAST_CONTRAST * np.sqrt(small.size):
        return whole
    first = round(COLUMNS * panorama.first / panorama.period_px)
    whole[:, (first + np.arange(columns)) % COLUMNS] = contrast / size
    return whole
