"""Kanade-Lucas-Tomasi tracking on panoramas, of which a full turn wraps around, with the forward-backward check.

Below it: normalised correlation of windows, and turns between two panoramas by circular correlation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry import patch_kernels
from omnid.core.odometry.patch_kernels import CONVERGED_PX
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]

STEP_RAD = math.radians(18)  # the paper's step, Dang et al. 2012, section IV.F
PEAKS = 3  # Peaks of the correlation that are tried, at least half of a step apart.
MAX_GRADIENT = 100.0  # grey levels, Sobel: stronger edges are cut, so that none dominates the correlation


@dataclass(frozen=True, slots=True)
class KltSettings:
    """Settings of the pyramidal Lucas-Kanade tracker and of the forward-backward check."""

    window_px: int = 15  # side of the tracking window, px
    levels: int = 3  # pyramid levels above the image
    max_error_px: float = 0.5  # largest forward-backward error of a track, px
    iterations: int = 20  # iterations on each pyramid level


def track(a: PaddedPanorama, b: PaddedPanorama, points: Array, guess: Array, klt: KltSettings) -> tuple[Array, Flags]:
    """Track points (N, 2) of a into b, from a guess (N, 2), with the forward-backward check.

    Returns the pixels (N, 2) in b and flags (N,) of those that the track back leads to where they started. Columns are
    returned in [0, width). The status of Lucas-Kanade is no evidence: it only states that the iteration ended.
    """
    there, found = flow(a, b, points, guess, klt)
    back, returned = flow(b, a, there, points, klt)
    error = back - points
    error[:, 0] = a.wrap(error[:, 0])
    close = (error**2).sum(axis=1) < klt.max_error_px**2
    return there, found & returned & close


def flow(a: PaddedPanorama, b: PaddedPanorama, points: Array, guess: Array, klt: KltSettings) -> tuple[Array, Flags]:
    """Track points (N, 2) of a into b by pyramidal Lucas-Kanade, from a guess (N, 2), without the check.

    Returns the pixels (N, 2) in b and flags (N,) of those that ended inside the image.
    """
    if not len(points):  # OpenCV refuses them
        return points.copy(), np.zeros(0, bool)
    start, target = (np.ascontiguousarray(padded(*at)[:, None], np.float32) for at in ((a, points), (b, guess)))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, klt.iterations, CONVERGED_PX)
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        a.image,
        b.image,
        start,
        target,
        winSize=(klt.window_px, klt.window_px),
        maxLevel=klt.levels,
        criteria=criteria,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    moved = there.reshape(-1, 2).astype(float)
    inside = (moved[:, 1] >= 0) & (moved[:, 1] <= b.image.shape[0] - 1)
    moved[:, 0], shown = b.unpadded(moved[:, 0])
    return moved, (status.ravel() > 0) & inside & shown & np.isfinite(moved).all(axis=1)


def padded(panorama: PaddedPanorama, pixels: Array) -> Array:
    """Return pixels (N, 2) of the padded image."""
    return np.column_stack([panorama.padded(pixels[:, 0]), pixels[:, 1]])


def correlations(images: tuple[Image, Image], at: Array, there: Array, side: int) -> Array:
    """Return the correlations (K, N) of windows about places (N, 2) of one image with those there (K, N, 2) in another.

    A window has side^2 pixels, between which greys are interpolated; one without texture has none: 0.
    """
    found = np.empty(there.shape[:2])
    patch_kernels.correlate(*images, at, there, side, found)
    return found


def correlation_peaks(before: Image, after: Image, usable: Flags, period_px: int = 0) -> list[float]:
    """Return the likeliest turns to the left [rad] from one panorama (H, W) to the next, best first, in [-pi, pi).

    Circular correlation of the horizontal gradients over azimuth, exact at the seam because nothing is padded.
    Structure that is fixed to the rig must be left out by usable (H, W), because it holds the peak at zero.
    period_px: columns of a full turn, of which a sector shows only its own; 0: all are shown.
    """
    width = period_px or before.shape[1]
    spectrum = np.conj(_spectrum(before, usable, width)) * _spectrum(after, usable, width)
    score = np.fft.irfft(spectrum.sum(axis=0), width)
    apart = round(width * STEP_RAD / (4 * math.pi))
    peaks = []
    for _ in range(PEAKS):
        shift = int(score.argmax())
        peaks.append(((shift + width / 2) % width - width / 2) * 2 * math.pi / width)
        score[np.arange(shift - apart, shift + apart + 1) % width] = -np.inf
    return peaks


def _spectrum(image: Image, usable: Flags, period_px: int) -> NDArray[np.complex64]:
    """Return the spectrum (H, turn / 2 + 1) over azimuth of the horizontal gradient."""
    wrapped = np.hstack([image[:, -1:], image, image[:, :1]])
    gradient = cv2.Sobel(wrapped, cv2.CV_32F, 1, 0)[:, 1:-1]
    limited = np.clip(gradient, -MAX_GRADIENT, MAX_GRADIENT) * usable
    return np.fft.rfft(limited, period_px, axis=1).astype(np.complex64)
