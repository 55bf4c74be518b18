"""Detection of boards with markers: any visible part of a board counts.

The markers that can be read predict the corners around them, to second order; these are found as saddle points of grey,
also those of markers that could not be read.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.boards.board import BoardView
from calib.boards.board_shape import quadratic_terms
from calib.boards.corner_candidates import BLUR_PX, Grey, describe_corners, smoothed
from calib.boards.corner_grid import WINDOW_PART, refine_subpixel
from calib.boards.corner_refinement import refine_in_mappings
from calib.boards.derived_images import Image
from calib.boards.marker_board import MarkerBoard
from calib.boards.marker_reading import read_markers
from calib.models.camera import Array

# Points of which a mapping is fitted: the nearest ones, its reach [squares], width of their Gaussian weight
# [squares].
NEAREST, REACH, WEIGHT_WIDTH = 24, 3.0, 1.5
# Least numbers of points of a mapping of third, second and first order, because these have 10, 6 and 3 terms.
MIN_CUBIC, MIN_QUADRATIC, MIN_AFFINE = 16, 10, 4
# Least ratio of the mapping's singular values.
MIN_CONDITION = 0.02
# A predicted corner lies at most this far from a known one [squares]; it may move by a part of its square and pixels.
MAX_AHEAD, MAX_MOVE, MAX_MOVE_PX = 1.1, 0.12, 1.5
# Radius of the ring about a corner, in parts of the window, and least radius [px].
RING_PART, MIN_RING_PX = 1.2, 1.8
# Half side of the window of the first refinement [px]; a smaller one has fewer than nine pixels, too few.
MIN_WINDOW_PX = 1.5
ROUNDS = 12  # enough: the boards of test_marker_finder.py take 2 to 4
# Least quality of a corner's ring, because the edge of what hides the board crosses others.
MIN_QUALITY = 0.4
# Largest distance of a corner from the mapping of the others: in squares, and in pixels added to it.
MAX_IRREGULARITY, MAX_IRREGULARITY_PX = 0.03, 0.4
# Least number of corners, and how far they lie off one line (ratio of the standard deviations), because fewer, or those
# of a line, determine no pose well.
MIN_CORNERS, MIN_SPREAD = 8, 0.1


@dataclass(frozen=True, slots=True)
class LocalMapping:
    """Coefficients (6, 2) of pixels by 1, x, y, x^2, xy, y^2 about a place of a board [squares].

    gain: ratio of the standard deviations of the place's pixel and of the points' pixels; above 1 beyond their outline,
    infinite for a mapping of first order, which does not hold the curvature of a mirror image.
    """

    coefficients: Array
    gain: float


def find_marker_board(image: Image, board: MarkerBoard, name: str = "", *, thorough: bool = True) -> BoardView | None:
    """Find the visible corners of a board with markers in an image (H, W) uint8; None if there are too few.

    The view's pixels are NaN for corners that are hidden; its confidence is the share of visible ones.
    """
    layout = board.markers
    markers = read_markers(image, layout, thorough=thorough)
    if not markers:
        return None
    on_board = dict(zip(layout.ids.tolist(), layout.corners / board.square_m, strict=True))
    places = np.concatenate([on_board[number] for number in markers])
    outlines = np.concatenate(list(markers.values()))
    points = board.points[:, :2] / board.square_m
    pixels = _grown(smoothed(image, BLUR_PX), points, places, outlines, board.window)
    pixels = _refined(image.astype(np.float32), points, pixels, board.window)
    seen = np.isfinite(pixels[:, 0])
    if seen.sum() < MIN_CORNERS or not _is_spread(points[seen]):
        return None
    return BoardView(name, pixels, float(seen.mean()))


def _grown(image: Grey, points: Array, places: Array, outlines: Array, window: float) -> Array:
    """Return the pixels (N, 2) of the board's points [squares] that the image shows, NaN for the others.

    places (M, 2) [squares] and outlines (M, 2) [px]: the markers' corners.
    """
    pixels = np.full(points.shape, np.nan)
    at, where = places, outlines
    refused = np.zeros(len(points), bool)
    for _ in range(ROUNDS):
        tried = np.flatnonzero(np.isnan(pixels[:, 0]) & ~refused)
        mappings = {int(k): mapping for k in tried if (mapping := local_mapping_at(points[k], at, where)) is not None}
        if not mappings:
            break
        found = _accepted(image, mappings, window)
        refused[[k for k in mappings if k not in found]] = True
        if not found:
            break
        pixels[list(found)] = np.array(list(found.values()))
        new = np.isfinite(pixels[:, 0])
        # Corners are more accurate than the outlines of markers, which remain where there are no corners yet.
        far = np.linalg.norm(places[:, None] - points[new], axis=2).min(axis=1) > REACH
        at, where = np.vstack([points[new], places[far]]), np.vstack([pixels[new], outlines[far]])
    return pixels


def local_mapping_at(place: Array, at: Array, where: Array, *, exact: bool = False) -> LocalMapping | None:
    """Fit the mapping from the board to the image about a place (2,) [squares] of the board.

    at (M, 2) [squares], where (M, 2) [px]: known points; exact: they are refined corners, whose third order is fitted
    too. None if too few are near, or all on one side far away.
    """
    offset = at - place
    distance = np.linalg.norm(offset, axis=1)
    near = np.argsort(distance)[:NEAREST]
    near = near[distance[near] < REACH]
    if len(near) < MIN_AFFINE or distance[near[0]] > MAX_AHEAD:
        return None
    weight = np.exp(-((distance[near] / WEIGHT_WIDTH) ** 2) / 2)[:, None]
    x, y = offset[near].T
    terms = np.column_stack([quadratic_terms(x, y), x**3, x * x * y, x * y * y, y**3])
    counts = [
        count
        for count, least in ((10, MIN_CUBIC), (6, MIN_QUADRATIC), (3, MIN_AFFINE))
        if len(near) >= least and (exact or count < 10)
    ]
    for count in counts:
        left, values, right = np.linalg.svd(terms[:, :count] * weight, full_matrices=False)
        if values[-1] > MIN_CONDITION * values[0]:
            inverse = (right.T / values) @ left.T * weight.T
            coefficients = np.vstack([(inverse @ where[near])[:6], np.zeros((max(0, 6 - count), 2))])
            return LocalMapping(coefficients, float(np.linalg.norm(inverse[0])) if count > 3 else np.inf)
    return None


def _accepted(image: Grey, mappings: dict[int, LocalMapping], window: float) -> dict[int, Array]:
    """Return the predicted corners that the image shows, by number."""
    start = np.array([mapping.coefficients[0] for mapping in mappings.values()])
    sizes = np.array([_side_px(mapping) for mapping in mappings.values()])
    height, width = image.shape
    inside = ((start > 3) & (start < np.array([width, height]) - 4)).all(axis=1) & (window * sizes > MIN_WINDOW_PX)
    refined = start.copy()
    refined[inside] = refine_subpixel(image, start[inside], window / WINDOW_PART * sizes[inside])
    seen = describe_corners(image, refined, np.maximum(MIN_RING_PX, RING_PART * window * sizes))
    near = np.linalg.norm(refined - start, axis=1) < MAX_MOVE * sizes + MAX_MOVE_PX
    good = inside & near & (seen.quality > MIN_QUALITY)
    return {k: pixel for k, pixel, fine in zip(mappings, refined, good, strict=True) if fine}


def _side_px(mapping: LocalMapping) -> float:
    """Return the narrower side of a square in a mapping [px]."""
    return float(np.linalg.svd(mapping.coefficients[1:3], compute_uv=False)[-1])


def _refined(grey: Grey, points: Array, pixels: Array, window: float) -> Array:
    """Return the pixels moved onto the corners, without those off the mapping of their neighbours."""
    good = pixels.copy()
    seen = [int(k) for k in np.flatnonzero(np.isfinite(pixels[:, 0]))]
    mappings = {k: mapping for k in seen if (mapping := _mapping_of_others(points, pixels, k)) is not None}
    if mappings:
        own = np.array([np.vstack([pixels[k], mapping.coefficients[1:]]) for k, mapping in mappings.items()])
        good[list(mappings)] = refine_in_mappings(grey, own, own[:, 0], window)
    for _ in range(len(points)):
        left = [int(k) for k in np.flatnonzero(np.isfinite(good[:, 0]))]
        off = {k: _irregularity(_mapping_of_others(points, good, k), good[k]) for k in left}
        worst = max(off, key=lambda k: off[k], default=None)
        if worst is None or off[worst] < 1:
            break
        # One at a time: an outlier spoils the mappings of its neighbours.
        good[worst] = np.nan
    return good


def _mapping_of_others(points: Array, pixels: Array, k: int) -> LocalMapping | None:
    others = np.isfinite(pixels[:, 0])
    others[k] = False
    return local_mapping_at(points[k], points[others], pixels[others], exact=True)


def _irregularity(mapping: LocalMapping | None, pixel: Array) -> float:
    """Return the distance of a corner from the mapping of the others, in parts of the largest one.

    Outside their outline they determine it less well; 0 where they do not. Infinite if there are none.
    """
    if mapping is None:
        return np.inf
    off = np.linalg.norm(mapping.coefficients[0] - pixel)
    limit = MAX_IRREGULARITY * _side_px(mapping) + MAX_IRREGULARITY_PX
    return float(off / (limit * max(1.0, mapping.gain) ** 2))


def _is_spread(points: Array) -> bool:
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(values[1] > MIN_SPREAD * values[0])
