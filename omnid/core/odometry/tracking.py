"""Kanade-Lucas-Tomasi tracking on panoramas, of which a full turn wraps around, with the forward-backward check."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]


CONVERGED_PX = 0.01  # OpenCV's default: an iteration that moves the window less is the last one
# Levels of a pyramid: a panorama of 380 rows has 6 rows left on the sixth, too few for a window.
MAX_LEVELS = 6
MIN_EIGENVALUE = 1e-4  # Of the window's gradients; OpenCV's default: below it the window has no texture.


@dataclass(frozen=True, slots=True)
class KltSettings:
    """Settings of the pyramidal Lucas-Kanade tracker and of the forward-backward check."""

    window_px: Annotated[int, Meta(ge=5, le=61), "side of the tracking window, px"] = 15
    levels: Annotated[int, Meta(ge=0, le=MAX_LEVELS), "pyramid levels above the image"] = 3
    max_error_px: Annotated[float, Meta(ge=0.01, le=10), "largest forward-backward error of a track, px"] = 0.5
    iterations: Annotated[int, Meta(ge=1, le=200), "iterations on each pyramid level"] = 20


def track(
    a: PaddedPanorama, b: PaddedPanorama, points: Array, guess: Array, klt: KltSettings
) -> tuple[Array, NDArray[np.bool_]]:
    """Track points (N, 2) of a into b, from a guess (N, 2), with the forward-backward check.

    Returns the pixels (N, 2) in b and flags (N,) of those that the track back leads to where they started. Columns are
    returned in [0, width). The status of Lucas-Kanade is no evidence: it only states that the iteration ended.
    """
    if not len(points):
        return points.copy(), np.zeros(0, bool)
    there, found = flow(a, b, points, guess, klt)
    back, returned = flow(b, a, there, points, klt)
    error = back - points
    error[:, 0] = a.apart(error[:, 0])
    close = (error**2).sum(axis=1) < klt.max_error_px**2
    return there, found & returned & close


def flow(
    a: PaddedPanorama, b: PaddedPanorama, points: Array, guess: Array, klt: KltSettings
) -> tuple[Array, NDArray[np.bool_]]:
    """Track points (N, 2) of a into b by pyramidal Lucas-Kanade, from a guess (N, 2), without the check.

    Returns the pixels (N, 2) in b and flags (N,) of those that ended inside the image.
    """
    start, target = _padded(points, a), _padded(guess, b)
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
        minEigThreshold=MIN_EIGENVALUE,
    )
    moved = there.reshape(-1, 2).astype(float)
    inside = (moved[:, 1] >= 0) & (moved[:, 1] <= b.image.shape[0] - 1)
    moved[:, 0], shown = b.unpadded(moved[:, 0])
    return moved, (status.ravel() > 0) & inside & shown & np.isfinite(moved).all(axis=1)


def _padded(points: Array, panorama: PaddedPanorama) -> NDArray[np.float32]:
    """Return points (N, 1, 2) float32 in the padded image."""
    columns = panorama.padded(points[:, 0])
    return np.ascontiguousarray(np.stack([columns, points[:, 1]], axis=1)[:, None, :], np.float32)
