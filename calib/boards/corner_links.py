"""Links between corner candidates that are neighbours on a checkerboard: joined by an edge between light and dark.

Every corner has four arms, numbered 0 to 3 by rising angle in the image: both edges, each in both directions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib.boards.corner_candidates import CornerCandidates, Grey, sample
from calib.models.camera import Array

Indices = NDArray[np.int64]
# Number of nearest candidates among which an arm's neighbour is chosen, because a grid has so many within three
# squares.
NEAREST = 28
# Largest angle between an arm and the line to its neighbour, because edges in a mirror image are curved.
MAX_TURN_RAD = np.deg2rad(22)
# The edge between two neighbours is sampled on both sides, ASIDE of its length away, at the fractions ALONG of it.
# Its two sides must differ by MIN_EDGE of the corners' contrast.
ASIDE, MIN_EDGE = 0.17, 0.3
ALONG = np.linspace(0.2, 0.8, 5)
# No index, because the least one is 0.
NO_NEIGHBOUR = -1


def link_neighbours(image: Grey, corners: CornerCandidates) -> tuple[Indices, Indices]:
    """Return the neighbour (N, 4) of every corner's arm, and the arm of that neighbour that points back (N, 4).

    Only links that both ends choose are kept; all others are NO_NEIGHBOUR.
    """
    count = len(corners)
    neighbour, back = (np.full((count, 4), NO_NEIGHBOUR, np.int64) for _ in range(2))
    if count < 2:
        return neighbour, back
    # 1. Pairs of near candidates, the farthest first.
    near = min(NEAREST, count - 1) + 1
    lengths, found = cKDTree(corners.pixels).query(corners.pixels, near)
    a, b = np.repeat(np.arange(count), near), found.ravel().astype(np.int64)
    farthest = np.argsort(-lengths.ravel(), kind="stable")
    a, b = a[farthest], b[farthest]
    a, b = a[a != b], b[a != b]
    # 2. The arms that point to each other, with the light on the same side of the line between them.
    step = corners.pixels[b] - corners.pixels[a]
    angle = np.arctan2(step[:, 1], step[:, 0])
    arm_a, arm_b = _arm_along(corners.angles[a], angle), _arm_along(corners.angles[b], angle + np.pi)
    left_is_light = corners.light[a] ^ (arm_a % 2 == 1)
    fits = (arm_a >= 0) & (arm_b >= 0) & (left_is_light == ~(corners.light[b] ^ (arm_b % 2 == 1)))
    a, b, arm_a, arm_b, step, left_is_light = (one[fits] for one in (a, b, arm_a, arm_b, step, left_is_light))
    # 3. An edge along the line, with light and dark on the same sides as at a's arm.
    across = ASIDE * np.column_stack([-step[:, 1], step[:, 0]])  # towards larger angles
    middle = corners.pixels[a][:, None] + ALONG[:, None] * step[:, None]
    difference = sample(image, middle + across[:, None]) - sample(image, middle - across[:, None])
    signed = np.where(left_is_light, 1, -1)[:, None] * difference
    seen = signed.min(axis=1) > MIN_EDGE * np.minimum(corners.contrast[a], corners.contrast[b])
    # 4. The nearest neighbour of each arm, which is written last, where both ends choose each other.
    neighbour[a[seen], arm_a[seen]] = b[seen]
    back[a[seen], arm_a[seen]] = arm_b[seen]
    kept = (neighbour != NO_NEIGHBOUR) & (neighbour[neighbour, back] == np.arange(count)[:, None])
    kept &= back[neighbour, back] == np.arange(4)
    return np.where(kept, neighbour, NO_NEIGHBOUR), np.where(kept, back, NO_NEIGHBOUR)


def _arm_along(edges: Array, angle: Array) -> Indices:
    """Return the arm (M,) of corners with edges (M, 2) [rad] that points along an angle (M,); NO_NEIGHBOUR if none."""
    arms = np.concatenate([edges, edges + np.pi], axis=1)
    off = np.abs((arms - angle[:, None] + np.pi) % (2 * np.pi) - np.pi)
    best = off.argmin(axis=1)
    return np.where(np.take_along_axis(off, best[:, None], axis=1)[:, 0] < MAX_TURN_RAD, best, NO_NEIGHBOUR)
