"""Likelihood of range scans in an occupancy grid: Thrun, Burgard, Fox 2005, "Probabilistic Robotics", section 6.4."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.mapping.occupancy_grid import FREE, OCCUPIED, Grid
from omnid.core.mapping.range_scan import RangeScan, azimuths

Array = NDArray[np.float64]

BEAMS: Final = 60  # Beams of a scan that are compared; every sixth degree; by trial on development seeds.
SIGMA_M: Final = 0.12  # standard deviation of a range, that of the map included; by trial on development seeds
COARSE_SIGMA_M: Final = 0.35  # the same for poses drawn at random, of which none is exact
# Likelihood of a range that has nothing to do with the map, relative to that of a right one; by trial on development
# seeds.
RANDOM: Final = 0.1
# Share of independent beams, because neighbours see the same wall, and the same error of the map.
INDEPENDENT: Final = 0.2
# Distance from an obstacle of the map, up to which a beam fits; 2.5 SIGMA_M; by trial on development seeds.
HIT_M: Final = 0.3
NOT_FREE: Final = -3.0  # log likelihood of a pose where the map has no free space; by trial on development seeds


class BeamModel:
    """Logarithms of likelihoods of poses (N, 3) = (x, y, yaw) [m, rad] in a grid."""

    def __init__(self, grid: Grid) -> None:
        self._cell_m, self._corner = grid.cell_m, np.array(grid.corner)
        self._shape = grid.cells.shape
        # One more row and column at each side: what lies outside the grid.
        cells = np.pad(grid.cells, 1, constant_values=-1)
        empty = np.where(cells == OCCUPIED, 0, 1).astype(np.uint8)
        distance_m = cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * grid.cell_m
        if empty.all():
            distance_m = np.full(cells.shape, 1e3, np.float32)
        self._log = {
            sigma_m: np.log(np.exp(-0.5 * (distance_m / sigma_m) ** 2) + RANDOM).astype(np.float32).ravel()
            for sigma_m in (SIGMA_M, COARSE_SIGMA_M)
        }
        self._fits = (distance_m < HIT_M).ravel()
        self._standing = np.where(cells == FREE, 0.0, NOT_FREE).ravel()
        self._free = np.argwhere(grid.cells == FREE)

    @property
    def free_m2(self) -> float:
        """Area of the free cells."""
        return len(self._free) * self._cell_m**2

    def drawn(self, count: int, rng: np.random.Generator) -> Array:
        """Return poses (count, 3) drawn from the free cells and all headings; none where no cell is free."""
        if not len(self._free):
            return np.zeros((0, 3))
        cells = self._free[rng.integers(0, len(self._free), count)]
        xy = (cells[:, ::-1] + rng.random((count, 2))) * self._cell_m + self._corner
        return np.column_stack([xy, rng.uniform(-math.pi, math.pi, count)])

    def log_likelihood(self, poses: Array, scan: RangeScan, *, coarse: bool = False) -> Array:
        """Return the logarithms (N,) of the likelihoods of a scan at poses."""
        table = self._log[COARSE_SIGMA_M if coarse else SIGMA_M]
        beams = _beams(scan)
        if not len(beams):
            return np.zeros(len(poses))
        standing = self._standing[self._cells(poses[:, None, 0], poses[:, None, 1])][:, 0]
        return np.asarray(INDEPENDENT * table[self._ends(poses, beams)].sum(axis=1, dtype=np.float64) + standing)

    def fitting(self, pose: Array, scan: RangeScan) -> float:
        """Return the share of the beams of a scan that end at obstacles of the map, seen from one pose (3,)."""
        beams = _beams(scan)
        return float(self._fits[self._ends(pose[None], beams)].mean()) if len(beams) else 0.0

    def _ends(self, poses: Array, beams: NDArray[np.float32]) -> NDArray[np.int32]:
        """Return the cells (N, B) in which beams (B, 2) end."""
        x, y, yaw = poses.astype(np.float32).T[:, :, None]
        c, s = np.cos(yaw), np.sin(yaw)
        return self._cells(x + c * beams[:, 0] - s * beams[:, 1], y + s * beams[:, 0] + c * beams[:, 1])

    def _cells(self, x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.int32]:
        """Return the places in the flat tables of coordinates [m]; those outside are in the border."""
        height, width = self._shape
        column = np.clip(np.floor((x - self._corner[0]) / self._cell_m), -1, width).astype(np.int32) + 1
        row = np.clip(np.floor((y - self._corner[1]) / self._cell_m), -1, height).astype(np.int32) + 1
        return np.asarray(row * (width + 2) + column, np.int32)


def _beams(scan: RangeScan) -> NDArray[np.float32]:
    """Return the ends (B, 2) [m] of at most BEAMS known ranges, evenly chosen, in the frame of the scan."""
    known = np.flatnonzero(np.isfinite(scan))
    if len(known) > BEAMS:
        known = known[np.linspace(0, len(known), BEAMS, endpoint=False).astype(np.intp)]
    angle = azimuths()[known]
    return np.asarray(scan[known, None] * np.column_stack([np.cos(angle), np.sin(angle)]), np.float32)
