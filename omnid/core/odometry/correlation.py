"""Normalised correlation of the windows of two panoramas, and the wrong periods of disparity that it shows.

Along a column, texture that repeats matches at several rows of the upper panorama. Courses of bricks of the height c
fit at every disparity d (1 - k c / B), B the baseline, whatever their distance. Dense stereo chooses by its
surroundings, and at the ends of a sector these are few: twenty bricks in a row at 5 m were measured at 50 m. Points so
far hardly move with the robot's lateral motion, so that they decide between it and a turn: the pose was wrong by seven
sigmas.

The landmarks that the map knows nearby have been seen from several places, which show their depth. A new one whose
disparity is not theirs, and whose patch matches as well at theirs, is left out; where it matches at its own only it is
another surface. In the first keyframe there are none: see first_depths.py.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.tracking import KltSettings
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]
Pair = tuple[PaddedPanorama, PaddedPanorama]

NEIGHBOURS = 5  # known landmarks whose median disparity counts, because two of them may be of another surface
# Two disparities whose ratio is larger are of two surfaces, because the slope of one surface changes them by 0.15
# px/px. A match within the second, as a share of the neighbours' disparity, is at theirs.
OTHER_RATIO, SAME_SHARE = 1.25, 0.2
SIDE_PX = KltSettings().window_px  # side of a patch
# By how much the correlation of the patch at its own disparity exceeds that at another one where it does not repeat,
# because identical bricks differ by less than 0.05, other textures by 0.3 and more.
LEAST_LEAD = 0.15
MOST_ALIKE = 10  # disparities of one landmark, because courses of 6 cm fit into a baseline of 0.5 m less often
APART_PX = 3.0  # least distance of two of them, more than the width of a peak


def normalised_patches(
    panorama: PaddedPanorama, pixels: Array, side: int, step_px: int = 1, image: Floats | None = None
) -> tuple[Floats, Floats]:
    """Return patches (N, side^2) of zero mean and unit length about pixels (N, 2), and their standard deviations (N,).

    Greys between pixels are interpolated; beyond the image its border is repeated. step_px: between two samples. image:
    a padded one that is sampled in place of the panorama's. The product of two patches is their correlation.
    """
    source = panorama.image if image is None else image
    offsets = ((np.arange(side) - side // 2) * step_px).astype(np.float32)
    columns = panorama.padded(pixels[:, :1]).astype(np.float32) + np.tile(offsets, side)
    rows = pixels[:, 1:].astype(np.float32) + np.repeat(offsets, side)
    patches = np.zeros(columns.shape, np.float32)
    if len(pixels):  # OpenCV refuses empty maps
        patches[:] = cv2.remap(source, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    patches -= patches.mean(axis=1, keepdims=True)
    length = np.linalg.norm(patches, axis=1)
    # A patch without contrast divides by no zero.
    return np.asarray(patches / np.maximum(length, 1e-9)[:, None]), np.asarray(length / side)


def has_wrong_period(pair: Pair, pixels: Array, rows: Array, known: Array) -> Flags:
    """Return flags (N,) of pixels (N, 2) with upper rows (N,) that match as well at the disparity around them.

    known (M, 3) [px]: views of landmarks of the map, NaN: not seen in the upper panorama. A match beyond the image
    cannot be excluded.
    """
    found = np.zeros(len(pixels), bool)
    known = known[np.isfinite(known).all(axis=1)]
    if len(known) < NEIGHBOURS or not len(pixels):
        return found
    away = pair[0].apart(pixels[:, :1] - known[:, 0]) ** 2 + (pixels[:, 1:] - known[:, 1]) ** 2
    nearest = np.argpartition(away, NEIGHBOURS - 1, axis=1)[:, :NEIGHBOURS]
    own, around = rows - pixels[:, 1], np.median((known[:, 2] - known[:, 1])[nearest], axis=1)
    differs = (own > OTHER_RATIO * around) | (around > OTHER_RATIO * own)
    for n in np.flatnonzero(differs):
        reach = int(np.ceil(SAME_SHARE * around[n]))
        there = np.concatenate([rows[n : n + 1], pixels[n, 1] + around[n] + np.arange(-reach, reach + 1)])
        lower, _ = normalised_patches(pair[0], np.rint(pixels[n : n + 1]), SIDE_PX)
        at = np.column_stack([np.full(len(there), pixels[n, 0]), there])
        scores = normalised_patches(pair[1], np.rint(at), SIDE_PX)[0] @ lower[0]
        found[n] = scores[0] - scores[1:].max() < LEAST_LEAD or there[-1] > len(pair[1].image) - 1
    return found


def matching_disparities(pair: Pair, views: Array, most_px: int) -> Array:
    """Return disparities (N, K) [px] up to most_px at which views (N, 3) [px] match: their own first, then the best.

    The others are peaks of the correlation within LEAST_LEAD of the own one; NaN: there are no more.
    """
    own, found = views[:, 2] - views[:, 1], np.full((len(views), MOST_ALIKE), np.nan)
    lower, _ = normalised_patches(pair[0], np.rint(views[:, :2]), SIDE_PX)
    # 1. The correlation at all disparities; -1 where the panorama ends.
    scores = np.full((len(views), most_px + 1), -1.0, np.float32)
    for disparity in range(most_px + 1):
        there = np.rint(views[:, :2] + [0.0, disparity])
        inside = np.flatnonzero(there[:, 1] < len(pair[1].image))
        scores[inside, disparity] = (lower[inside] * normalised_patches(pair[1], there[inside], SIDE_PX)[0]).sum(axis=1)
    # 2. Its peaks, to fractions of a pixel by a parabola, away from the own disparity.
    before, peak, after = scores[:, :-2], scores[:, 1:-1], scores[:, 2:]
    at = np.arange(1, most_px) + (before - after) / np.minimum(2 * (before - 2 * peak + after), -1e-6)
    nearest = np.clip(np.rint(own)[:, None].astype(np.intp) + np.arange(-1, 2), 0, most_px)
    at_own = np.take_along_axis(scores, nearest, axis=1).max(axis=1, keepdims=True)
    is_peak = (peak >= before) & (peak > after) & (peak > at_own - LEAST_LEAD)
    ranked = np.where(is_peak & (np.abs(at - own[:, None]) > APART_PX), peak, -np.inf)
    order = np.argsort(-ranked, axis=1, kind="stable")[:, : MOST_ALIKE - 1]
    kept = np.isfinite(np.take_along_axis(ranked, order, axis=1))
    found[:, 0], found[:, 1 : 1 + order.shape[1]] = own, np.where(kept, np.take_along_axis(at, order, axis=1), np.nan)
    return found
