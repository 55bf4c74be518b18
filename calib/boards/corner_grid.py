"""Grids of linked corners, and the corners that no candidate stood for, looked for where their neighbours say."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards.corner_candidates import Corners, Grey, look_at
from calib.boards.corner_links import NOBODY, link
from calib.models.camera import Array

Cell = tuple[int, int]
Grid = dict[Cell, Array]  # pixel (2,) of the corner at (column, row); column to row turns clockwise in the image
STEPS: tuple[Cell, ...] = ((1, 0), (0, 1), (-1, 0), (0, -1))
MAX_CELLS = 61 * 61
MAX_ROUNDS = 64
# A corner that neighbours predict is looked for within this part of their distance, and so wide is its ring.
SEARCH_PART = 0.3
RING_PART = 0.28
MIN_RING_PX = 2.0
MIN_QUALITY = 0.15
# What has to be left of the contrast that the corner's neighbours have.
MIN_CONTRAST_PART = 0.25


def find_grids(image: Grey, corners: Corners) -> list[Grid]:
    """Grids (four corners at least) of a image's candidates, the largest first."""
    neighbour, back = link(image, corners)
    squares = _in_square(neighbour, back)
    neighbour = np.where(squares, neighbour, NOBODY)
    taken = np.zeros(len(corners), bool)
    grids = []
    for seed in np.argsort(-(neighbour != NOBODY).sum(axis=1), kind="stable"):
        if not taken[seed] and (neighbour[seed] != NOBODY).any():
            cells = _spread(int(seed), neighbour, back)
            taken[list(cells.values())] = True
            grids.append({cell: corners.pixels[index] for cell, index in cells.items()})
    return sorted((grid for grid in grids if len(grid) >= 4), key=len, reverse=True)


def _in_square(neighbour: NDArray[np.int64], back: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which links (N, 4) are a side of a closed square on one hand or the other."""
    closed = np.zeros(neighbour.shape, bool)
    for turn in (1, 3):
        node, arm = (np.broadcast_to(values, neighbour.shape).copy()
                     for values in (np.arange(len(neighbour))[:, None], np.arange(4)))
        whole = np.ones(neighbour.shape, bool)
        for _ in range(4):
            ahead, arriving = neighbour[node, arm], back[node, arm]
            whole &= ahead != NOBODY
            node, arm = np.where(whole, ahead, 0), np.where(whole, (arriving + 2 + turn) % 4, 0)
        closed |= whole & (node == np.arange(len(neighbour))[:, None]) & (arm == np.arange(4))
    return closed


def _spread(seed: int, neighbour: NDArray[np.int64], back: NDArray[np.int64]) -> dict[Cell, int]:
    """Cells of all corners that links lead to from the seed, each corner and each cell once, the nearest first."""
    place: dict[int, tuple[Cell, int]] = {seed: ((0, 0), 0)}  # corner -> its cell, and its arm along the columns
    cells, queue = {(0, 0): seed}, deque([seed])
    while queue and len(cells) < MAX_CELLS:
        node = queue.popleft()
        (column, row), along = place[node]
        for direction, (di, dj) in enumerate(STEPS):
            arm = (along + direction) % 4
            other, cell = int(neighbour[node, arm]), (column + di, row + dj)
            if other != NOBODY and other not in place and cell not in cells:
                place[other] = cell, int(back[node, arm] - direction - 2) % 4
                cells[cell] = other
                queue.append(other)
    return cells


def grow(image: Grey, grid: Grid) -> Grid:
    """The grid with every corner added that its neighbours predict and the image shows."""
    grid, refused = dict(grid), set[Cell]()
    for _ in range(MAX_ROUNDS):
        guesses = {cell: guess for cell in _border(grid) - refused if (guess := predict(grid, cell)) is not None}
        if not guesses or len(grid) > MAX_CELLS:
            break
        found = _look(image, grid, guesses)
        refused |= set(guesses) - set(found)
        for cell in found:  # what was refused may be better predicted with a new neighbour
            refused -= {(cell[0] + di, cell[1] + dj) for di, dj in STEPS}
        grid |= found
        if not found:
            break
    return grid


def _border(grid: Grid) -> set[Cell]:
    return {(i + di, j + dj) for i, j in grid for di, dj in STEPS} - set(grid)


def predict(grid: Grid, cell: Cell) -> Array | None:
    """Where (2,) the neighbours of a cell expect it; None where too few are known."""
    guesses = list(_guesses(grid, cell))
    return np.median(guesses, axis=0) if guesses else None


def _guesses(grid: Grid, cell: Cell) -> Iterator[Array]:
    i, j = cell
    for di, dj in STEPS:
        one, two, three = (grid.get((i + n * di, j + n * dj)) for n in (1, 2, 3))
        behind = grid.get((i - di, j - dj))
        if one is not None and behind is not None:
            yield (one + behind) / 2
        elif one is not None and two is not None:
            yield 2 * one - two if three is None else 2.5 * one - 2 * two + 0.5 * three
        side, corner = grid.get((i - dj, j + di)), grid.get((i + di - dj, j + dj + di))
        if one is not None and side is not None and corner is not None:
            yield one + side - corner


def spacing(grid: Grid, cell: Cell) -> float:
    """Distance [px] from a cell to the nearest of the corners next to it, measured among its neighbours; 0: unknown."""
    i, j = cell
    steps = [np.linalg.norm(one - other) for di, dj in STEPS
             if (one := grid.get((i + di, j + dj))) is not None
             and (other := grid.get(cell, grid.get((i + 2 * di, j + 2 * dj)))) is not None]
    beside = [np.linalg.norm(one - other) for di, dj in STEPS for side in (1, -1)
              if (one := grid.get((i + di, j + dj))) is not None
              and (other := grid.get((i + di - side * dj, j + dj + side * di))) is not None]
    return float(min(steps or beside, default=0.0))


def _look(image: Grey, grid: Grid, guesses: Grid) -> Grid:
    """The predicted corners that are there."""
    sizes = np.array([spacing(grid, cell) for cell in guesses])
    start = np.array(list(guesses.values()))
    settled = settle(image, start, sizes)
    seen = look_at(image, settled, np.maximum(MIN_RING_PX, RING_PART * sizes))
    contrast = _usual_contrast(image, grid)
    near = np.linalg.norm(settled - start, axis=1) < np.maximum(1.5, SEARCH_PART * sizes)
    good = near & (sizes > 3) & (seen.quality > MIN_QUALITY) & (seen.contrast > MIN_CONTRAST_PART * contrast)
    return {cell: pixel for cell, pixel, fine in zip(guesses, settled, good, strict=True) if fine}


def _usual_contrast(image: Grey, grid: Grid) -> float:
    rings = np.array([max(MIN_RING_PX, RING_PART * spacing(grid, cell)) for cell in grid])
    return float(np.median(look_at(image, np.array(list(grid.values())), rings).contrast))


def settle(image: Grey, pixels: Array, sizes: Array) -> Array:
    """Pixels (N, 2) moved to the corner within reach; sizes (N,) [px] of the squares around set the window."""
    settled = pixels.astype(np.float32).reshape(-1, 1, 2).copy()
    half = np.clip(np.rint(0.3 * sizes), 2, 15).astype(int)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
    height, width = image.shape
    inside = ((pixels > half[:, None] + 2) & (pixels < np.array([width, height]) - half[:, None] - 3)).all(axis=1)
    for window in np.unique(half[inside]):
        mine = np.flatnonzero((half == window) & inside)
        settled[mine] = cv2.cornerSubPix(image, settled[mine].copy(), (int(window),) * 2, (-1, -1), stop)
    return np.asarray(settled.reshape(-1, 2), float)
