"""Occupancy grid of the range scans of keyframes, kept up to date while keyframes are added and loops move them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.mapping.occupancy_grid import Grid, known_part
from omnid.core.mapping.scan_grid import ScanGrid, reach_m

Array = NDArray[np.float64]

MAX_CELLS: Final = 1_000_000  # 50 m by 50 m at cells of 0.05 m, so that a message has 1 MB.
MARGIN_M: Final = 5.0  # around the area of the scans, so that it need not grow with each of them
# The grid is drawn again when a keyframe has moved farther than this, because less than half a cell changes no cell;
# 0.3 degrees are half a cell at 5 m.
MOVED_CELLS, MOVED_RAD = 0.5, math.radians(0.3)


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeScans:
    """Range scans of keyframes by their ids in the order of addition, and the poses (K, 4, 4) of their frames."""

    scans: Mapping[int, NDArray[np.float16]]  # (360,) each, see range_scan.py
    free_m: Mapping[int, NDArray[np.float16]]  # (360,) each, up to which floor was seen, see FreeRanges
    T_map_rect: Array
    loops: tuple[tuple[int, int], ...] = ()  # ids of the keyframes between which places were recognised


class KeyframeGrid:
    """The grid; new scans are drawn into it, and all again where a keyframe has moved or left."""

    def __init__(self, cell_m: float) -> None:
        self._cell_m = cell_m
        self._drawn: dict[int, tuple[float, float, float]] = {}  # x, y [m], yaw [rad] of the keyframes in it
        self._area = np.array([[np.inf, np.inf], [-np.inf, -np.inf]])  # lowest and highest x, y [m]
        self._grid: ScanGrid | None = None
        self.redrawn = 0

    def draw(self, keyframes: KeyframeScans, T_base_rect: Array) -> Grid:
        """Return the known part of the grid, in the axes of the base at the start of the map."""
        poses = T_base_rect @ keyframes.T_map_rect.reshape(-1, 4, 4)
        planar = {
            id: (float(T[0, 3]), float(T[1, 3]), math.atan2(T[1, 0], T[0, 0]))
            for id, T in zip(keyframes.scans, poses, strict=True)
        }
        needed = _area(keyframes, planar)
        fits = bool((needed[0] >= self._area[0]).all() and (needed[1] <= self._area[1]).all())
        if self._grid is None or not fits or any(self._has_moved(id, planar.get(id)) for id in self._drawn):
            self._area = needed + np.array([[-MARGIN_M], [MARGIN_M]])
            self._grid, self._drawn = ScanGrid(self._area[0], self._area[1], self._cell_m, MAX_CELLS), {}
            self.redrawn += 1
        for id, (x, y, yaw) in planar.items():
            if id not in self._drawn:
                scan, free_m = (of[id].astype(np.float32) for of in (keyframes.scans, keyframes.free_m))
                self._grid.add(scan, free_m, x, y, yaw)
                self._drawn[id] = x, y, yaw
        return known_part(self._grid.grid())

    def _has_moved(self, id: int, now: tuple[float, float, float] | None) -> bool:
        """True if a keyframe that was drawn has left, or is elsewhere now."""
        if now is None:
            return True
        x, y, yaw = self._drawn[id]
        return (
            math.hypot(now[0] - x, now[1] - y) > MOVED_CELLS * self._cell_m
            or abs(math.remainder(now[2] - yaw, 2 * math.pi)) > MOVED_RAD
        )


def _area(keyframes: KeyframeScans, planar: Mapping[int, tuple[float, float, float]]) -> Array:
    """Return the lowest and highest x, y (2, 2) [m] that scans reach; those of the origin without scans."""
    if not planar:
        return np.zeros((2, 2))
    xy = np.array([pose[:2] for pose in planar.values()])
    reach = np.array([[reach_m(scan)] for scan in keyframes.scans.values()])
    return np.array([(xy - reach).min(axis=0), (xy + reach).max(axis=0)])
