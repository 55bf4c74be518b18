"""Detection of corners spread over the panorama, and their disparity in the pair."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import at_pixels, at_scale
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Side, at scale 1, of the cells among which the corners are shared out evenly: in a panorama of 1300 x 380 px there are
# about 200 cells, so that each has two or three of the 500 landmarks wanted.
CELL_PX = 48
BLOCK_PX = 5  # Side of the window over which the gradients of a corner are summed.
# Side of the square in which a corner is the maximum, and least distance of a new landmark from a known one: two thirds
# of a patch, because nearer ones would share most of their texture, and so their errors. At all scales, because patches
# have as many pixels at each.
APART_PX = 9
MIN_RESPONSE = 2e-4  # smallest eigenvalue of a corner, in OpenCV's scale for 8 bit images
# Response that noise of one grey level reaches in 1 % of the pixels, as measured. The response grows with the square of
# the noise.
NOISE_RESPONSE = 2.5e-5
REACH_PX = 3  # eq. (8): largest distance, in column and in row, of a located pixel from a feature


def corners(lower: PaddedPanorama, usable: Flags, max_count: int) -> Array:
    """Return corners (N, 2) = (column, row), at most max_count, where usable (H, W), strongest first per cell.

    A corner is a maximum of the smaller eigenvalue (Shi and Tomasi 1994) within APART_PX. Cells of CELL_PX take turns,
    so that one poster full of contrast does not take all.
    """
    response = cv2.cornerMinEigenVal(lower.image, BLOCK_PX)
    peaks = cv2.dilate(response, np.ones((APART_PX, APART_PX), np.uint8))
    least = max(MIN_RESPONSE, NOISE_RESPONSE * lower.noise_grey**2)
    inner = slice(lower.pad_px, lower.pad_px + lower.width)
    is_peak = (response[:, inner] >= peaks[:, inner]) & (response[:, inner] > least) & usable
    rows, columns = np.nonzero(is_peak)
    strongest = np.lexsort((columns, rows, -response[rows, columns + lower.pad_px]))
    rows, columns = rows[strongest], columns[strongest]
    cell_px = at_scale(CELL_PX, lower.scale)
    rank = _rank_within((rows // cell_px) * lower.width + columns // cell_px)
    chosen = np.argsort(rank, kind="stable")[: max(0, max_count)]
    return np.column_stack([columns[chosen], rows[chosen]]).astype(float)


def _rank_within(group: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the rank (N,) of each element among those of its own group, in the order given."""
    order = np.argsort(group, kind="stable")
    sorted_group = group[order]
    first = np.searchsorted(sorted_group, sorted_group, side="left")
    rank = np.empty(len(group), np.intp)
    rank[order] = np.arange(len(group)) - first
    return rank


def clear_around(usable: Flags, points: Array) -> Flags:
    """Return usable (H, W) without discs of APART_PX around points (N, 2), so that no landmark is detected twice."""
    free = usable.astype(np.uint8)
    for column, row in np.rint(points).astype(int).tolist():
        cv2.circle(free, (column, row), APART_PX, 0, -1)
    return free.astype(bool)


def nearby_disparity(disparity: NDArray[np.float32], points: Array) -> Array:
    """Return the median disparity (N,) of the located pixels within REACH_PX of points (N, 2); NaN where there is none.

    A feature counts as located if a located point lies close to it: Dang et al. 2012, eq. (8).
    """
    offsets = np.stack(np.meshgrid(*2 * [np.arange(-REACH_PX, REACH_PX + 1)]), axis=-1).reshape(-1, 2)
    around = np.sort(at_pixels(disparity, np.rint(points)[:, None] + offsets), axis=1)  # NaN last
    count = np.isfinite(around).sum(axis=1)
    return np.asarray(around[np.arange(len(points)), np.maximum(count - 1, 0) // 2], float)
