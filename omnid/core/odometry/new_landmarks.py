"""New landmarks of a keyframe: located in the upper panorama, without those whose depth is a wrong period.

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

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.corners import REACH_PX, nearby_disparity
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.local_map import NewLandmarks
from omnid.core.odometry.plane_patches import align_rows, disparity_slopes, fitted_slopes, view_noise
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings, correlations, padded, track
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Pair = tuple[PaddedPanorama, PaddedPanorama]

# Largest horizontal error of a vertical match, at all scales, because matches err by parts of a pixel at each; a right
# calibration errs by 0.1 degrees, 0.4 px of 1300 columns.
CROSS_PX = 0.7
# Share of the landmarks of a first keyframe that match at one disparity only, below which the others are left out:
# rendered rooms with a wall of bricks have 0.42 and more. Left out everywhere, they double the error of the scale.
LEAST_UNIQUE_SHARE = 0.4
NEIGHBOURS = 5  # known landmarks whose median disparity counts, because two of them may be of another surface
# Two disparities whose ratio is larger are of two surfaces, because the slope of one surface changes them by 0.15
# px/px. A match within the second, as a share of the neighbours' disparity, is at theirs.
OTHER_RATIO, SAME_SHARE = 1.25, 0.2
SIDE_PX = KltSettings().window_px  # side of a patch
# By how much the correlation of the patch at its own disparity exceeds that at another one where it does not repeat,
# because identical bricks differ by less than 0.05, other textures by 0.3 and more.
LEAST_LEAD = 0.15


def located(
    frame: StereoFrame, points: Array, model: StereoModel, klt: KltSettings, exposure: Exposure, known: Array
) -> NewLandmarks:
    """Return the corners (N, 2) of the lower panorama that the upper panorama shows too.

    They are located by SAD (eq. 8), and then by KLT and by their patches to a fraction of a pixel. known (M, 3) [px]:
    views of the map's landmarks.
    """
    # 1. Disparity by dense stereo.
    dense = frame.disparity
    guess, spread_px = exposure.upper_pixels(points, nearby_disparity(dense, points))
    pair, near = (frame.lower, frame.upper), np.full((len(points), 2), np.nan)
    # 2. Track into the upper panorama, to below the point and near the guessed column, and align the patch there with
    #    the slopes of its surface.
    guessed = np.flatnonzero(np.isfinite(guess).all(axis=1))
    there, good = track(*pair, points[guessed], guess[guessed], klt)
    good &= np.abs(frame.lower.wrap(there[:, 0] - guess[guessed, 0])) < CROSS_PX + spread_px[guessed]
    good &= there[:, 1] > points[guessed, 1]
    near[guessed[good]] = there[good]
    slopes = disparity_slopes(dense, points, near[:, 1] - points[:, 1])
    slopes = fitted_slopes(pair, points, near, slopes, model)
    rows, variance = align_rows(pair, points, near, slopes, model)
    found = np.isfinite(rows)
    found[found] = ~_has_wrong_period(pair, points[found], rows[found], known, round(model.cylinder.focal_px))
    # 3. Correct the views for the motion during the exposures.
    views, shift = exposure.corrected(points[found], rows[found])
    noise = view_noise(np.zeros((2, 2)), variance[found]) + shift.noise
    return NewLandmarks(points[found], views, slopes[found], noise)


def _has_wrong_period(pair: Pair, pixels: Array, rows: Array, known: Array, most_px: int) -> Flags:
    """Return flags (N,) of pixels (N, 2) with upper rows (N,) whose disparity, up to most_px, may be another one."""
    known, own, last = known[np.isfinite(known).all(axis=1)], rows - pixels[:, 1], len(pair[1].image) - 1
    if not len(pixels) or 0 < len(known) < NEIGHBOURS:
        return np.zeros(len(pixels), bool)
    # 1. Other disparities: all, or those of the known landmarks around where these differ. Where a match at theirs
    #    would lie below the upper panorama it cannot be excluded.
    if len(known):
        away = pair[0].wrap(pixels[:, :1] - known[:, 0]) ** 2 + (pixels[:, 1:] - known[:, 1]) ** 2
        nearest = np.argpartition(away, NEIGHBOURS - 1, axis=1)[:, :NEIGHBOURS]
        around = np.median((known[:, 2] - known[:, 1])[nearest], axis=1)
        reach_px, own_px = np.ceil(SAME_SHARE * around), 1
        first, end = np.rint(around) - reach_px, np.rint(around) + reach_px + 1
        wrong = (own > OTHER_RATIO * around) | (around > OTHER_RATIO * own)
        compared = wrong & (pixels[:, 1] + around + reach_px <= last)
    else:
        first, end, own_px = np.zeros(len(pixels)), np.full(len(pixels), most_px + 1.0), REACH_PX
        wrong = compared = np.ones(len(pixels), bool)
    # 2. The best correlations of the patch at its own and at the others.
    places, images = padded(pair[0], pixels), (pair[0].image, pair[1].image)
    for n in np.flatnonzero(compared):
        at_own = np.rint(own[n]) + np.arange(-own_px, own_px + 1)
        elsewhere = np.setdiff1d(np.arange(first[n], end[n]), at_own)
        here, scores = np.rint(places[n : n + 1]), []
        for disparities in (at_own, elsewhere):
            there = here + np.multiply.outer(disparities, [[0.0, 1.0]])
            scores.append(correlations(images, here, there[there[:, 0, 1] <= last], SIDE_PX).max(initial=-1.0))
        wrong[n] = len(elsewhere) > 0 and scores[1] > scores[0] - LEAST_LEAD
    return np.asarray(wrong & (len(known) > 0 or wrong.mean() > 1 - LEAST_UNIQUE_SHARE))
