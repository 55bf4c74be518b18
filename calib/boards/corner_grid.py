"""Grids of linked corners, grown by corners that the image shows where their neighbours predict them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib.boards.board import WINDOW
from calib.boards.corner_candidates import RING_PX, CornerCandidates, Grey, describe_corners, sample
from calib.boards.local_mapping import LocalMapping, local_mapping, predicted_corners
from calib.models.camera import Array

Cell = tuple[int, int]
Key = TypeVar("Key")
# Pixel (2,) of the corner at (column, row). The turn from the column axis to the row axis is clockwise in the image.
Grid = dict[Cell, Array]
# To the neighbours along columns and rows: exact.
STEPS: tuple[Cell, ...] = ((1, 0), (0, 1), (-1, 0), (0, -1))


def find_grids(image: Grey, corners: CornerCandidates) -> list[Grid]:
    """Link an image's candidates to grids of a square at least, the largest first."""
    neighbour, back = link_neighbours(image, corners)
    squares = _in_square(neighbour, back)
    neighbour = np.where(squares, neighbour, NO_NEIGHBOUR)
    used = np.zeros(len(corners), bool)
    grids = []
    for seed in np.argsort(-(neighbour != NO_NEIGHBOUR).sum(axis=1), kind="stable"):
        if not used[seed] and (neighbour[seed] != NO_NEIGHBOUR).any():
            cells = _flood_fill(int(seed), neighbour, back)
            used[list(cells.values())] = True
            grids.append({cell: corners.pixels[index] for cell, index in cells.items()})
    return sorted((grid for grid in grids if len(grid) >= 4), key=len, reverse=True)


def _in_square(neighbour: NDArray[np.int64], back: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the mask (N, 4) of links that are a side of a closed square, to the left or to the right."""
    closed = np.zeros(neighbour.shape, bool)
    for turn in (1, 3):
        node, arm = (
            np.broadcast_to(values, neighbour.shape).copy()
            for values in (np.arange(len(neighbour))[:, None], np.arange(4))
        )
        whole = np.ones(neighbour.shape, bool)
        for _ in range(4):
            ahead, arriving = neighbour[node, arm], back[node, arm]
            whole &= ahead != NO_NEIGHBOUR
            node, arm = np.where(whole, ahead, 0), np.where(whole, (arriving + 2 + turn) % 4, 0)
        closed |= whole & (node == np.arange(len(neighbour))[:, None]) & (arm == np.arange(4))
    return closed


def _flood_fill(seed: int, neighbour: NDArray[np.int64], back: NDArray[np.int64]) -> dict[Cell, int]:
    """Return the cells of all corners linked to the seed, by breadth-first search; each corner and cell once."""
    # Corner -> its cell, and the number of its arm along the columns.
    placed: dict[int, tuple[Cell, int]] = {seed: ((0, 0), 0)}
    cells, queue = {(0, 0): seed}, deque([seed])
    while queue:
        node = queue.popleft()
        (column, row), along = placed[node]
        for direction, (di, dj) in enumerate(STEPS):
            arm = (along + direction) % 4
            other, cell = int(neighbour[node, arm]), (column + di, row + dj)
            if other != NO_NEIGHBOUR and other not in placed and cell not in cells:
                placed[other] = cell, int(back[node, arm] - direction - 2) % 4
                cells[cell] = other
                queue.append(other)
    return cells


def grow_grid(image: Grey, grid: Grid, max_count: int) -> Grid:
    """Return the grid with every corner added that the mapping of its neighbours predicts and the image shows.

    A grid of more than most corners does not grow any further.
    """
    grid, refused = dict(grid), set[Cell]()
    while len(grid) <= max_count:
        at, where = np.array(list(grid), float), np.array(list(grid.values()))
        border = {(i + di, j + dj) for i, j in grid for di, dj in STEPS} - set(grid) - refused
        mappings = {cell: local_mapping(np.array(cell, float), at, where) for cell in border}
        found = shown_corners(image, mappings, WINDOW)
        if not found:
            break
        refused |= {cell for cell, mapping in mappings.items() if mapping is not None} - set(found)
        # A refused cell may be predicted better with a new neighbour.
        for cell in found:
            refused -= {(cell[0] + di, cell[1] + dj) for di, dj in STEPS}
        grid |= found
    return grid


def shown_corners(image: Grey, mappings: Mapping[Key, LocalMapping | None], window: float) -> dict[Key, Array]:
    """Return the corners with a mapping (None: not predicted) that the image shows, refined.

    window: half side [squares] of the window about a corner in which grey depends on that corner alone.
    """
    predicted = {key: mapping for key, mapping in mappings.items() if mapping is not None}
    if not predicted:
        return {}
    radius = np.maximum(RING_PX, window * np.array([mapping.side_px for mapping in predicted.values()]))
    refined, moves = predicted_corners(image, list(predicted.values()), window)
    seen = describe_corners(image, refined, radius)
    inside = ((refined > RING_PX) & (refined < np.array(image.shape[::-1]) - 1 - RING_PX)).all(axis=1)
    is_resolved = np.array([2 * window * mapping.side_px > RING_PX for mapping in predicted.values()])
    good = inside & (moves > 0) & (moves < window / 2) & is_resolved & (seen.quality > 0)
    return {key: pixel for key, pixel, fine in zip(predicted, refined, good, strict=True) if fine}


def with_clockwise_axes(grid: Grid) -> Grid:
    """Return the grid, its axes swapped if necessary, so that columns turn clockwise to rows."""
    turns = [
        np.linalg.det(np.stack([along - corner, down - corner]))
        for (i, j), corner in grid.items()
        if (along := grid.get((i + 1, j))) is not None and (down := grid.get((i, j + 1))) is not None
    ]
    if np.sum(np.sign(turns)) >= 0:
        return grid
    return {(row, column): pixel for (column, row), pixel in grid.items()}


Indices = NDArray[np.int64]
# Number of nearest candidates among which an arm's neighbour is chosen, because a grid has so many within three
# squares.
NEAREST = 28
# Largest angle between an arm and the line to its neighbour, because edges in a mirror image are curved.
MAX_TURN_RAD = np.deg2rad(22)
# The edge between two neighbours is sampled at these fractions of it, on both sides, the first fraction away.
ALONG = np.linspace(0.2, 0.8, 5)
# No index, because the least one is 0.
NO_NEIGHBOUR = -1


def link_neighbours(image: Grey, corners: CornerCandidates) -> tuple[Indices, Indices]:
    """Return the neighbour (N, 4) of every corner's arm, and the arm of that neighbour that points back (N, 4).

    Neighbours are joined by an edge between light and dark. Every corner has four arms, numbered 0 to 3 by rising angle
    in the image: both edges, each in both directions. Only links that both ends choose are kept; all others are
    NO_NEIGHBOUR.
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
    across = ALONG[0] * np.column_stack([-step[:, 1], step[:, 0]])  # towards larger angles
    middle = corners.pixels[a][:, None] + ALONG[:, None] * step[:, None]
    difference = sample(image, middle + across[:, None]) - sample(image, middle - across[:, None])
    seen = (np.where(left_is_light, 1, -1)[:, None] * difference > 0).all(axis=1)
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
    return np.where(off.min(axis=1) < MAX_TURN_RAD, off.argmin(axis=1), NO_NEIGHBOUR)
