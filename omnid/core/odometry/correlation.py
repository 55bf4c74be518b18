"""Normalised correlation of the windows of two panoramas, and the wrong periods of disparity that it shows.

Along a column, texture that repeats matches at several rows of the upper panorama. Courses of bricks of the height c
fit at every disparity d (1 - k c / B), B the baseline, whatever their distance. Dense stereo chooses by its
surroundings, and at the ends of a sector these are few: twenty bricks in a row at 5 m were measured at 50 m. Points so
far hardly move with the robot's lateral motion, so that they decide between it and a turn: the pose was wrong by seven
sigmas.

The landmarks that the map knows nearby have been seen from several places, which show their depth. A new one whose
disparity is not theirs, and whose patch matches as well at theirs, is left out; where it matches at its own only it is
another surface. In the first keyframe there are none: where nearly all landmarks match at several disparities, only
the others make the map, and all that come later are compared with these.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.corners import REACH_PX
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


def repeats(pair: Pair, pixels: Array, rows: Array, most_px: int) -> Flags:
    """Return flags of pixels (N, 2) with upper rows (N,) that match as well at another disparity, up to most_px."""
    lower, _ = normalised_patches(pair[0], np.rint(pixels), SIDE_PX)
    own = np.rint(rows - pixels[:, 1])
    # 1. The correlation at all disparities; -1 where the panorama ends.
    scores = np.full((len(pixels), most_px + 1), -1.0, np.float32)
    for disparity in range(most_px + 1):
        there = np.rint(pixels + np.array([0.0, disparity]))
        upper, _ = normalised_patches(pair[1], there, SIDE_PX)
        scores[:, disparity] = np.where(there[:, 1] < len(pair[1].image), (lower * upper).sum(axis=1), -1.0)
    # 2. The best one near the own disparity, and the best one elsewhere.
    is_own = np.abs(np.arange(most_px + 1) - own[:, None]) <= REACH_PX
    at_own = np.where(is_own, scores, -1.0).max(axis=1)
    return np.asarray(np.where(is_own, -1.0, scores).max(axis=1) > at_own - LEAST_LEAD)
