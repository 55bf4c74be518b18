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
Floats = NDArray[np.float32]

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
MOST_ALIKE = 10  # disparities of one landmark, because courses of 6 cm fit into a baseline of 0.5 m less often
APART_PX = 3.0  # least distance of two of them, more than the width of a peak


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
        lower = _patches(pair[0], pixels[n : n + 1, 0], pixels[n, 1:])
        at_own, elsewhere = (
            float(np.max(_patches(pair[1], np.full(len(at), pixels[n, 0]), at) @ lower[0], initial=-1.0))
            for at in (rows[n : n + 1], there)
        )
        found[n] = at_own - elsewhere < LEAST_LEAD
    return found


def disparities_alike(pair: tuple[PaddedPanorama, PaddedPanorama], views: Array, most_px: int) -> Array:
    """Return disparities (N, K) [px] up to most_px at which views (N, 3) [px] match: their own first, then the best.

    The others are peaks of the correlation within LEAST_LEAD of the own one; NaN: there are no more.
    """
    columns, rows, own = views[:, 0], views[:, 1], views[:, 2] - views[:, 1]
    lower, found = _patches(pair[0], columns, rows), np.full((len(views), MOST_ALIKE), np.nan)
    found[:, 0] = own
    # 1. The correlation at all disparities; -1 where the panorama ends.
    scores = np.full((len(views), most_px + 1), -1.0, np.float32)
    for disparity in range(most_px + 1):
        inside = np.flatnonzero(rows + disparity < len(pair[1].image))
        upper = _patches(pair[1], columns[inside], rows[inside] + disparity)
        scores[inside, disparity] = np.einsum("ns,ns->n", lower[inside], upper)
    # 2. Its peaks, to fractions of a pixel by a parabola, away from the own disparity.
    before, peak, after = scores[:, :-2], scores[:, 1:-1], scores[:, 2:]
    shift = (before - after) / np.minimum(2 * (before - 2 * peak + after), -1e-6)
    at = np.arange(1, most_px) + shift
    nearest = np.clip(np.rint(own).astype(np.intp), 1, most_px - 1)
    at_own = np.maximum.reduce([scores[np.arange(len(views)), nearest + step] for step in (-1, 0, 1)])
    is_peak = (peak >= before) & (peak > after) & (peak > at_own[:, None] - LEAST_LEAD)
    ranked = np.where(is_peak & (np.abs(at - own[:, None]) > APART_PX), peak, -np.inf)
    order = np.argsort(-ranked, axis=1, kind="stable")[:, : MOST_ALIKE - 1]
    kept = np.isfinite(np.take_along_axis(ranked, order, axis=1))
    found[:, 1 : 1 + order.shape[1]] = np.where(kept, np.take_along_axis(at, order, axis=1), np.nan)
    return found


def _disparity_around(lower: PaddedPanorama, pixels: Array, known: Array) -> Array:
    """Return the median disparity (N,) of the NEIGHBOURS nearest to pixels (N, 2)."""
    columns = lower.apart(pixels[:, :1] - known[:, 0])
    squared = columns**2 + (pixels[:, 1:] - known[:, 1]) ** 2
    nearest = np.argpartition(squared, NEIGHBOURS - 1, axis=1)[:, :NEIGHBOURS]
    return np.asarray(np.median((known[:, 2] - known[:, 1])[nearest], axis=1))


def normalised_patches(
    panorama: PaddedPanorama, pixels: Array, side: int, step_px: int = 1, image: Floats | None = None
) -> tuple[Floats, Floats]:
    """Return patches (N, side^2) of zero mean and unit length about pixels (N, 2), and their standard deviations (N,).

    step_px: between two of their samples. image: a padded one that is sampled in place of the panorama's.
    """
    source = panorama.image if image is None else image
    offsets = (np.arange(side) - side // 2) * step_px
    across = np.rint(panorama.padded(pixels[:, 0])).astype(np.intp)[:, None] + offsets
    down = np.rint(pixels[:, 1]).astype(np.intp)[:, None] + offsets
    at = down.clip(0, source.shape[0] - 1)[:, :, None], across.clip(0, source.shape[1] - 1)[:, None, :]
    patches = source[at].reshape(len(pixels), side**2).astype(np.float32)
    patches -= patches.mean(axis=1, keepdims=True)
    length = np.linalg.norm(patches, axis=1)
    return np.asarray(patches / np.maximum(length, 1e-9)[:, None], np.float32), np.asarray(length / side, np.float32)


def _patches(panorama: PaddedPanorama, columns: Array, rows: Array) -> Floats:
    """Return the patches (N, SIDE_PX^2) about pixels with columns and rows (N,)."""
    return normalised_patches(panorama, np.column_stack([columns, rows]), SIDE_PX)[0]
