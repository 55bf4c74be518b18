"""Wrong periods of the disparity: along a column, texture that repeats matches at several rows of the upper panorama.

Dense stereo chooses by its surroundings, and at the ends of a sector these are few: bricks at 5 m were taken for ones
at 50 m, twenty in a row. They hardly move with the robot's lateral motion, so that they distinguish it from a turn, and
moved the pose by seven sigmas. The landmarks that the map knows nearby have been seen from several places, which show
their depth. A new one whose disparity is not theirs, and whose patch fits as well at theirs, is left out; where it fits
at its own only it is another surface.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

NEIGHBOURS = 5  # known landmarks whose median disparity counts, because two of them may be of another surface
# Two disparities whose ratio is larger are of two surfaces, because the slope of one surface changes them by 0.15
# px/px.
OTHER_RATIO = 1.25
SIDE_PX = 15  # Side of a patch, because the tracker's window has as many.
# The patch is searched within this share of the neighbours' disparity, because slopes change it by less.
SEARCH_SHARE = 0.2
# By how much the correlation of the patch at its own disparity must exceed that at the neighbours', because identical
# bricks differ by less than 0.05, other textures by 0.3 and more.
LEAST_LEAD = 0.15


def has_wrong_period(pair: tuple[PaddedPanorama, PaddedPanorama], pixels: Array, rows: Array, known: Array) -> Flags:
    """Return flags (N,) of pixels (N, 2) with upper rows (N,) that match as well at the disparity around them.

    known (M, 3) [px]: views of landmarks of the map, NaN: not seen in the upper panorama.
    """
    found = np.zeros(len(pixels), bool)
    known = known[np.isfinite(known).all(axis=1)]
    if len(known) < NEIGHBOURS or not len(pixels):
        return found
    own, around = rows - pixels[:, 1], _disparity_around(pair[0], pixels, known)
    differs = (own > OTHER_RATIO * around) | (around > OTHER_RATIO * own)
    for n in np.flatnonzero(differs):
        reach = int(np.ceil(SEARCH_SHARE * around[n]))
        there = pixels[n, 1] + around[n] + np.arange(-reach, reach + 1)
        if there[-1] > len(pair[1].image) - 1:  # a motion that the image does not show cannot be excluded
            found[n] = True
            continue
        lower = _patches(pair[0], pixels[n, 0], pixels[n, 1:])
        at_own, elsewhere = (
            float(np.max(_patches(pair[1], pixels[n, 0], at) @ lower[0], initial=-1.0))
            for at in (rows[n : n + 1], there)
        )
        found[n] = at_own - elsewhere < LEAST_LEAD
    return found


def _disparity_around(lower: PaddedPanorama, pixels: Array, known: Array) -> Array:
    """Return the median disparity (N,) of the NEIGHBOURS nearest to pixels (N, 2)."""
    columns = lower.apart(pixels[:, :1] - known[:, 0])
    squared = columns**2 + (pixels[:, 1:] - known[:, 1]) ** 2
    nearest = np.argpartition(squared, NEIGHBOURS - 1, axis=1)[:, :NEIGHBOURS]
    return np.asarray(np.median((known[:, 2] - known[:, 1])[nearest], axis=1))


def _patches(panorama: PaddedPanorama, column: float, rows: Array) -> Array:
    """Return patches (R, SIDE_PX^2) of a column at rows (R,), of zero mean and unit length."""
    side = np.arange(SIDE_PX) - SIDE_PX // 2
    image = panorama.image
    columns = np.rint(panorama.padded(np.array([column]))).astype(np.intp) + side
    at = np.rint(rows).astype(np.intp)[:, None] + side
    patches = image[at.clip(0, len(image) - 1)[:, :, None], columns.clip(0, image.shape[1] - 1)].reshape(len(rows), -1)
    patches = patches - patches.mean(axis=1, keepdims=True)
    return np.asarray(patches / np.maximum(np.linalg.norm(patches, axis=1), 1e-9)[:, None])
