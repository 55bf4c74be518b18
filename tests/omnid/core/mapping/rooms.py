"""Range scans of rooms with flat walls, computed exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.range_scan import MAX_RANGE_M, SECTORS, RangeScan, azimuths

Array = NDArray[np.float64]

OPEN = np.full(SECTORS, MAX_RANGE_M, np.float32)  # free ranges, where floor was seen up to what stands on it


def pose(x: float, y: float, yaw: float) -> Array:
    """Return the pose (4, 4) of a frame on the floor."""
    return se3.transform(se3.rotation_exp([0, 0, yaw]), [x, y, 0.0])


def box(low: tuple[float, float], high: tuple[float, float]) -> Array:
    """Return the four walls (4, 2, 2) of a rectangle: two ends each."""
    (a, b), (c, d) = low, high
    corners = np.array([[a, b], [c, b], [c, d], [a, d]], float)
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def scan_of(walls: Array, at: Array, noise_m: float = 0.0, seed: int = 0) -> RangeScan:
    """Return the scan of walls (W, 2, 2) from a pose: the nearest wall in each direction."""
    angle = azimuths() + np.arctan2(at[1, 0], at[0, 0])
    ray = np.column_stack([np.cos(angle), np.sin(angle)])
    start, along = walls[:, 0] - at[:2, 3], walls[:, 1] - walls[:, 0]
    cross = ray[:, None, 0] * along[None, :, 1] - ray[:, None, 1] * along[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0])[None] / cross
        share = (start[None, :, 0] * ray[:, None, 1] - start[None, :, 1] * ray[:, None, 0]) / cross
    hit = (distance > 0) & (share >= 0) & (share <= 1)
    nearest = np.where(hit, distance, np.inf).min(axis=1)
    nearest += noise_m * np.random.default_rng(seed).normal(size=len(nearest))
    return np.where(nearest < MAX_RANGE_M, nearest, np.nan).astype(np.float32)
