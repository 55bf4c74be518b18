"""How the floor looks: its steps of grey, and how far a bin looks like it, learned from floor that is known.

Arrays (N, D) hold bins, from near to far, and directions.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles.ray_kernels import RayParameters

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

MAD: Final = 1.48  # sigma of a normal distribution by the median of its magnitudes
LEAST_STEP: Final = 0.35  # sigma of a step by the rounding of greys
ROW_BINS: Final = 20  # known bins of one range by which its steps are known
ROW_SHARE: Final = 0.4  # by which the sigma follows them from range to range
GREY_BINS: Final = 60  # known bins of one range by which its grey is known
TYPICAL_M: Final = 1.3  # range at which the near floor is seen
SIDE: Final = 3  # directions on either side with which a bin is compared


def sigma_of(values: Floats | Array) -> float:
    """Return the robust standard deviation of differences that are 0 in the mean."""
    return MAD * float(np.median(np.abs(values)))


def row_medians(values: Floats, chosen: Flags) -> Floats:
    """Return the medians (N,) of the chosen values of each row of (N, D), inf where none is chosen."""
    ordered = np.sort(np.where(chosen, values, np.float32(np.inf)), axis=1)
    return np.asarray(
        ordered[np.arange(len(values)), chosen.sum(axis=1) // 2 - (chosen.sum(axis=1) == values.shape[1])]
    )


def floor_steps(steps: Floats, near: Flags, known: Flags, p: RayParameters) -> tuple[Floats, float]:
    """Return the sigmas (N,) of steps (N, D) of the floor, and its rate of marks.

    known (N, D): bins that are known to be floor; near: those of them by which its look is learned.
    """
    least = max(sigma_of(steps[near]), LEAST_STEP)
    sigmas, last = np.empty(len(steps)), least
    of_rows, counts = MAD * row_medians(np.abs(steps), known), known.sum(axis=1)
    for n in range(len(steps)):
        if counts[n] >= ROW_BINS:
            last += ROW_SHARE * (of_rows[n] - last)
        sigmas[n] = last
    # The floor there, at most what it may be by the near floor.
    sigmas = np.clip(sigmas, max(0.5 * least, LEAST_STEP), 2.0 * least)
    seen = float((np.abs(steps) > 5 * sigmas[:, None])[near].mean())
    marks = (p.marks * p.marks_bins + seen * p.seen_bins) / (p.marks_bins + p.seen_bins)
    return sigmas.astype(np.float32), min(marks, 0.5)


def floor_look(steps: Floats, greys: Floats, ranges_m: Array, near: Flags, p: RayParameters) -> Floats:
    """Return the log-ratios (N, D) that a bin looks like the floor near to the base, to that it looks like anything.

    steps, greys (N, D); ranges_m (N,); near (N, D): bins that are known to be floor.
    """
    far = np.maximum(ranges_m / TYPICAL_M, 1.0)[:, None].astype(np.float32)
    by_contrast, by_outline = _by_contrast(steps, far, near), _by_outline(greys, far, near, p)
    by_grey, is_known = _by_grey(greys, near, p)
    total = np.clip(by_contrast, p.look_low, p.look_high) + np.clip(by_outline, p.look_low, p.look_high)
    # Far away the light of the near floor is all that is known.
    total += np.clip(by_grey, np.where(is_known, p.grey_low, p.look_low)[:, None], p.look_high)
    return np.asarray(p.w_look * total, np.float32)


def _by_contrast(steps: Floats, far: Floats, near: Flags) -> Floats:
    """Return the log-ratios (N, D) by the size of steps around; far away the same floor shows less."""
    size2 = cv2.blur(_turned(steps * steps, 1), (3, 5))[:, 1:-1]
    contrast = np.log(np.sqrt(np.maximum(size2, 0.0)) + np.float32(0.3))
    middle = float(np.median(contrast[near]))
    sigma = max(sigma_of(contrast[near] - middle), 0.25)
    z = contrast - np.float32(middle)
    sigmas = np.where(z < 0, np.float32(sigma) + np.log(far), np.float32(sigma))
    anything = np.exp(-0.5 * ((contrast - 1.0) / 1.3) ** 2) / 1.3 + 1e-9
    return np.asarray(np.log(0.9 * np.exp(-0.5 * (z / sigmas) ** 2) / sigmas + 0.1 * anything) - np.log(anything))


def _by_grey(greys: Floats, near: Flags, p: RayParameters) -> tuple[Floats, Flags]:
    """Return the log-ratios (N, D) by grey, and where (N,) the floor's is known at that range."""
    grey = float(np.median(greys[near]))
    sigma = max(sigma_of(greys[near] - grey), p.grey_share * grey)
    middles, sigmas = np.full(len(greys), grey, np.float32), np.full(len(greys), sigma, np.float32)
    is_known = near.sum(axis=1) > GREY_BINS
    middles[is_known] = row_medians(greys[is_known], near[is_known])
    of_rows = MAD * row_medians(np.abs(greys[is_known] - middles[is_known, None]), near[is_known])
    sigmas[is_known] = np.clip(of_rows, p.near_grey_share * grey, sigma)
    z, sigmas = greys - middles[:, None], sigmas[:, None]
    scale = 1.5 * p.contrast * max(grey, 20.0)
    anything = np.exp(-np.abs(z) / scale) / (2 * scale)
    core = np.exp(-0.5 * (z / sigmas) ** 2) / (sigmas * 2.5066)
    return np.asarray(np.log(0.9 * core + 0.1 * anything) - np.log(anything)), is_known


def _by_outline(greys: Floats, far: Floats, near: Flags, p: RayParameters) -> Floats:
    """Return the log-ratios (N, D) by the difference to both sides, of a bin or of five, whichever is less."""
    side = _turned(greys, SIDE)
    outline = greys - (side[:, : -2 * SIDE] + side[:, 2 * SIDE :]) / 2
    wide = cv2.blur(outline, (1, 5))
    outline = np.where(np.abs(outline) < np.abs(wide), outline, wide)
    sigmas = np.float32(max(sigma_of(outline[near]), 0.8)) * np.sqrt(far)
    z2 = (outline / sigmas) ** 2
    core = (np.exp(-0.5 * z2) * (1 - p.tail) + np.exp(-0.08 * z2) * p.tail * 0.4) / (sigmas * 2.5066)
    scale = p.contrast * max(float(np.median(greys[near])), 20.0)
    anything = np.exp(-np.abs(outline) / scale) / (2 * scale)
    # A thing shows an outline in half of its directions.
    return np.asarray(np.log(0.9 * core + 0.1 * anything) - np.log(0.5 * core + 0.5 * anything))


def _turned(values: Floats, count: int) -> Floats:
    """Return values (N, D) of a turn with so many directions repeated on either side."""
    return np.concatenate([values[:, -count:], values, values[:, :count]], axis=1)
