"""Which corner candidates are neighbours on a checkerboard: joined by one straight enough edge between light and dark.

Every corner has four arms, numbered 0 to 3 by rising angle in the image: both edges, each in both directions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.boards.corner_candidates import Corners, Grey, sample
from calib.models.camera import Array

# Of so many nearest candidates an arm's neighbour is chosen.
NEAREST = 28
# How far a neighbour may lie off the arm's direction: edges in a mirror are bent.
MAX_TURN_RAD = np.deg2rad(22)
# The edge between two neighbours is looked at on both sides, this part of its length away, at these fractions of it,
# and its two sides must differ by this part of the corners' contrast.
ASIDE = 0.17
ALONG = np.array([0.2, 0.35, 0.5, 0.65, 0.8])
MIN_EDGE = 0.3
NOBODY = -1


def link(image: Grey, corners: Corners) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The neighbour of every corner's arm (N, 4), NOBODY where there is none, and the neighbour's arm that points back.

    Only links that both ends choose are kept.
    """
    N = len(corners)
    neighbour, back = (np.full((N, 4), NOBODY, np.int64) for _ in range(2))
    if N < 2:
        return neighbour, back
    a, b, length = _pairs(corners.pixels)
    arm_a, arm_b = _arms(corners, a, b)
    fits = (arm_a >= 0) & (arm_b >= 0)
    fits &= _left_is_light(corners, a, arm_a) == ~_left_is_light(corners, b, arm_b)
    a, b, arm_a, arm_b = (values[fits] for values in (a, b, arm_a, arm_b))
    length = length[fits]
    seen = _edge_seen(image, corners, (a, b), arm_a)
    order = np.flatnonzero(seen)[np.argsort(-length[seen], kind="stable")]
    neighbour[a[order], arm_a[order]] = b[order]  # of several the nearest is written last
    back[a[order], arm_a[order]] = arm_b[order]
    return _mutual(neighbour, back)


def _pairs(pixels: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Indices a, b (M,) of near candidates and their distances [px]."""
    near = min(NEAREST, len(pixels) - 1)
    firsts, seconds, lengths = [], [], []
    norm = (pixels**2).sum(axis=1)
    for start in range(0, len(pixels), 512):
        block = pixels[start:start + 512]
        squared = np.maximum(norm[start:start + 512, None] + norm - 2 * block @ pixels.T, 0.0)
        squared[np.arange(len(block)), start + np.arange(len(block))] = np.inf
        chosen = np.argpartition(squared, near - 1, axis=1)[:, :near]
        firsts.append(np.repeat(start + np.arange(len(block)), near))
        seconds.append(chosen.ravel())
        lengths.append(np.sqrt(np.take_along_axis(squared, chosen, axis=1)).ravel())
    return np.concatenate(firsts), np.concatenate(seconds), np.concatenate(lengths)


def _arms(corners: Corners, a: NDArray[np.int64], b: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The arm of a that points to b and the one of b that points to a (M,); NOBODY where none does."""
    step = corners.pixels[b] - corners.pixels[a]
    angle = np.arctan2(step[:, 1], step[:, 0])
    return _arm_along(corners.angles[a], angle), _arm_along(corners.angles[b], angle + np.pi)


def _arm_along(edges: Array, angle: Array) -> NDArray[np.int64]:
    arms = np.concatenate([edges, edges + np.pi], axis=1)
    off = np.abs((arms - angle[:, None] + np.pi) % (2 * np.pi) - np.pi)
    best = off.argmin(axis=1)
    return np.where(np.take_along_axis(off, best[:, None], axis=1)[:, 0] < MAX_TURN_RAD, best, NOBODY)


def _left_is_light(corners: Corners, index: NDArray[np.int64], arm: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether it is light just beyond an arm, at a larger angle."""
    return np.asarray(corners.light[index] ^ (arm % 2 == 1))


def _edge_seen(image: Grey, corners: Corners, pair: tuple[NDArray[np.int64], NDArray[np.int64]],
               arm: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether light and dark lie on the sides of the line from a to b where a's arm has them."""
    start, step = corners.pixels[pair[0]], corners.pixels[pair[1]] - corners.pixels[pair[0]]
    aside = ASIDE * np.column_stack([-step[:, 1], step[:, 0]])  # towards larger angles
    middle = start[:, None] + ALONG[:, None] * step[:, None]
    difference = sample(image, middle + aside[:, None]) - sample(image, middle - aside[:, None])
    signed = np.where(_left_is_light(corners, pair[0], arm), 1, -1)[:, None] * difference
    contrast = np.minimum(corners.contrast[pair[0]], corners.contrast[pair[1]])
    return np.asarray(signed.min(axis=1) > MIN_EDGE * contrast)


def _mutual(neighbour: NDArray[np.int64], back: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    own = np.arange(len(neighbour))[:, None]
    returned = neighbour[neighbour, back] == own
    kept = (neighbour != NOBODY) & returned & (back[neighbour, back] == np.arange(4))
    return np.where(kept, neighbour, NOBODY), np.where(kept, back, NOBODY)
