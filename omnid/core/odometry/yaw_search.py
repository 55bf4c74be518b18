"""Hypotheses of the yaw between two panoramas: on a cylinder a rotation is a shift of the columns."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]

STEP_RAD = math.radians(18)  # the paper's step, Dang et al. 2012, section IV.F
PEAKS = 3  # Peaks of the correlation that are tried.
# Two peaks are at least a 36th of a full turn apart: 10 degrees, because nearer ones would be two samples of one peak.
PEAKS_APART = 36
MAX_GRADIENT = 100.0  # grey levels, Sobel: stronger edges are cut, so that none dominates the correlation
ROW_STEP = 2  # every second row is enough for the correlation


def steps() -> list[float]:
    """Return the paper's yaw hypotheses [rad] in order of magnitude: 0, 18, -18, 36, -36, ... 162, -162, 180 degrees.

    The paper counts from 0 to 342 degrees, and so tries a small turn to the right last.
    """
    both = [sign * k * STEP_RAD for k in range(1, 10) for sign in (1, -1)]
    return [0.0, *both, 10 * STEP_RAD]


def correlation_peaks(before: Image, after: Image, usable: Flags, turn_px: int = 0) -> list[float]:
    """Return the likeliest turns to the left [rad] from one panorama (H, W) to the next, best first, in [-pi, pi).

    Circular correlation of the horizontal gradients over azimuth, exact at the seam because nothing is padded.
    Structure that is fixed to the rig must be left out by usable (H, W), because it holds the peak at zero.
    turn_px: columns of a full turn, of which a sector shows only its own; 0: all are shown.
    """
    width = turn_px or before.shape[1]
    spectrum = np.conj(_spectrum(before, usable, width)) * _spectrum(after, usable, width)
    score = np.fft.irfft(spectrum.sum(axis=0), width)
    apart = width // PEAKS_APART
    peaks = []
    for _ in range(PEAKS):
        shift = int(score.argmax())
        peaks.append(((shift + width / 2) % width - width / 2) * 2 * math.pi / width)
        score[np.arange(shift - apart, shift + apart + 1) % width] = -np.inf
    return peaks


def _spectrum(image: Image, usable: Flags, turn_px: int) -> NDArray[np.complex64]:
    """Return the spectrum (H / ROW_STEP, turn / 2 + 1) over azimuth of the horizontal gradient."""
    wrapped = np.hstack([image[:, -1:], image, image[:, :1]])
    gradient = cv2.Sobel(wrapped, cv2.CV_32F, 1, 0)[:, 1:-1]
    limited = np.clip(gradient, -MAX_GRADIENT, MAX_GRADIENT) * usable
    return np.fft.rfft(limited[::ROW_STEP], turn_px, axis=1).astype(np.complex64)
