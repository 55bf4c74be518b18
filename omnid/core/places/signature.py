"""A small signature of a panorama, by which places are compared at any heading in a fraction of a millisecond."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

ROWS, COLUMNS = 16, 128
SMOOTH: Final = (31, 5)  # columns, rows: brightness that is taken out, as it changes with the light
LEAST_CONTRAST: Final = 4.0  # grey levels: below it there is nothing to compare

Signature = NDArray[np.complex64]


def signature(panorama: NDArray[np.uint8]) -> Signature:
    """Return the signature (ROWS, COLUMNS / 2 + 1) of a panorama (H, W) of a full turn.

    It is the spectrum over azimuth of the panorama at 16x128 pixels without its slow changes of brightness, scaled to
    length 1; zeros for a panorama without contrast.
    """
    small = cv2.resize(panorama, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA).astype(np.float32)
    pad = SMOOTH[0] // 2
    turned = cv2.copyMakeBorder(small, 0, 0, pad, pad, cv2.BORDER_WRAP)
    contrast = small - cv2.blur(turned, SMOOTH)[:, pad:-pad]
    size = float(np.linalg.norm(contrast))
    if size < LEAST_CONTRAST * np.sqrt(small.size):
        return np.zeros((ROWS, COLUMNS // 2 + 1), np.complex64)
    return np.fft.rfft(contrast / size, axis=1).astype(np.complex64)


def similarity(a: Signature, b: Signature) -> float:
    """Return the largest circular correlation of two panoramas over all headings, -1 .. 1."""
    return float(np.fft.irfft((a * b.conj()).sum(axis=0), COLUMNS).max())
