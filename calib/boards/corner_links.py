"""Links between corner candidates that are neighbours on a checkerboard: joined by an edge between light and dark.

Every corner has four arms, numbered 0 to 3 by rising angle in the image: both edges, each in both directions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib.boards.corner_candidates import CornerCandidates, Grey, sample
from calib.models.camera import Array

# Number of nearest candidates among which an arm's neighbour is chosen, because a grid has so many within three
# squares.
NEAREST = 28
# Largest angle between an arm and the line to its neighbour, because edges in a mirror image are curved.
MAX_TURN_RAD = np.deg2rad(22)
# The edge between two neighbours is sampled on both sides, ASIDE of its length away, at the fractions ALONG of it.
# Its two sides must differ by MIN_EDGE of the corners' contrast.
ASIDE = 0.17
ALONG = np.array([0.2, 0.35, 0.5, 0.65, 0.8])
MIN_EDGE = 0.3
# No index, because the least one is 0.
NO_NEIGHBOUR = -1


def link_neighbours(image: Grey, corners: CornerCandidates) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the neighbour (N, 4) of every corner's arm, and the arm of that neighbour that points back (N, 4).

    Only links that both ends choose are kept; all others are NO_NEIGHBOUR.
    """
    N = len(corners)
    neighbour, back = (np.full((N, 4), NO_NEIGHBOUR, np.int64) for _ in range(2))
    if N < 2:
        return neighbour, back
    a, b, length = _pairs(corners.pixels)
    arm_a, arm_b = _arms(corners, a, b)
    fits = (arm_a >= 0) & (arm_b >= 0)
    fits &= _left_is_light(corners, a, arm_a) == ~_left_is_light(corners, b, arm_b)
    a, b, arm_a, arm_b = (values[fits] for values in (a, b, arm_a, arm_b))
    length = length[fits]
    seen = _edge_seen(image, corners, a, b, arm_a)
    order = np.flatnonzero(seen)[np.argsort(-length[seen], kind="stable")]
    # Of several neighbours the nearest is written last.
    neighbour[a[order], arm_a[order]] = b[order]
    back[a[order], arm_a[order]] = arm_b[order]
    return _mutual_links(neighbour, back)


def _pairs(pixels: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return indices a, b (M,) of near candidates and their distances [px]."""
    near = min(NEAREST, len(pixels) - 1)
    lengths, found = cKDTree(pixels).query(pixels, near + 1)
    first = np.repeat(np.arange(len(pixels)), near + 1)
    second, length = found.ravel().astype(np.int64), lengths.ravel()
    other = first != second
    return first[other], second[other], length[other]


def _arms(
    corners: CornerCandidates, a: NDArray[np.int64], b: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the arm of a that points to b and the arm of b that points to a (M,); NO_NEIGHBOUR if there is none."""
    step = corners.pixels[b] - corners.pixels[a]
    angle = np.arctan2(step[:, 1], step[:, 0])
    return _arm_along(corners.angles[a], angle), _arm_along(corners.angles[b], angle + np.pi)


def _arm_along(edges: Array, angle: Array) -> NDArray[np.int64]:
    arms = np.concatenate([edges, edges + np.pi], axis=1)
    off = np.abs((arms - angle[:, None] + np.pi) % (2 * np.pi) - np.pi)
    best = off.argmin(axis=1)
    return np.where(np.take_along_axis(off, best[:, None], axis=1)[:, 0] < MAX_TURN_RAD, best, NO_NEIGHBOUR)


def _left_is_light(corners: CornerCandidates, index: NDArray[np.int64], arm: NDArray[np.int64]) -> NDArray[np.bool_]:
    """True (M,) if the image is light next to an arm, at a larger angle."""
    return np.asarray(corners.light[index] ^ (arm % 2 == 1))


def _edge_seen(
    image: Grey, corners: CornerCandidates, a: NDArray[np.int64], b: NDArray[np.int64], arm: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """True (M,) if light and dark along the line from a to b lie on the same sides as at a's arm."""
    start, step = corners.pixels[a], corners.pixels[b] - corners.pixels[a]
    # Perpendicular to the line, towards larger angles.
    across = ASIDE * np.column_stack([-step[:, 1], step[:, 0]])
    middle = start[:, None] + ALONG[:, None] * step[:, None]
    difference = sample(image, middle + across[:, None]) - sample(image, middle - across[:, None])
    signed = np.where(_left_is_light(corners, a, arm), 1, -1)[:, None] * difference
    contrast = np.minimum(corners.contrast[a], corners.contrast[b])
    return np.asarray(signed.min(axis=1) > MIN_EDGE * contrast)


def _mutual_links(neighbour: NDArray[np.int64], back: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    own = np.arange(len(neighbour))[:, None]
    returned = neighbour[neighbour, back] == own
    kept = (neighbour != NO_NEIGHBOUR) & returned & (back[neighbour, back] == np.arange(4))
    return np.where(kept, neighbour, NO_NEIGHBOUR), np.where(kept, back, NO_NEIGHBOUR)
