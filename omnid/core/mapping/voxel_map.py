"""Voxel map in bounded memory: points of all frames, in the world frame, fused in voxels; and the path of a run.

Dang et al. 2012, section IV.G: points reconstructed at each frame are transformed by the estimated motion into one
frame and merged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_AXIS_BITS = 21  # Bits of a packed key per axis, so that three of them fit the 63 bits of a positive key.
# A voxel: its sums are those of information (1 / variance), and of information times x, y, z.
VOXEL = np.dtype([("key", np.int64), ("sums", float, 4), ("frames", np.int32), ("last_seq", np.int64)])


@dataclass(frozen=True, slots=True)
class MapPoints:
    """A snapshot of the map, sorted by voxel; world frame."""

    xyz: NDArray[np.float32]  # (M, 3) m
    confidence: NDArray[np.float32]  # (M,) 0..1
    frames: NDArray[np.int32]  # (M,) frames that saw the voxel
    age: NDArray[np.int32]  # (M,) seqs since it was last seen


class VoxelMap:
    """Voxels in arrays that are sorted by their keys, of 52 bytes a voxel.

    Each voxel keeps the mean position weighted by information (1 / variance), its sum of weights, the number of frames
    that saw it and the last of them. Points are left out that are not finite, have no valid variance, or lie outside
    +-2^20 voxels.
    """

    def __init__(self, voxel_m: float = 0.05, max_voxels: int = 180_000) -> None:
        """voxel_m: edge of a voxel."""
        self._voxel_m, self._max_voxels = voxel_m, max_voxels
        self._newest_seq = 0
        self._voxels = np.zeros(0, VOXEL)

    def __len__(self) -> int:
        return len(self._voxels)

    def insert(self, points: Array, variance_m2: Array, seq: int) -> None:
        """Fuse the points (N, 3) of frame `seq`, in metres in the world frame, with their isotropic variances (N,)."""
        # 1. The voxels of the frame: sorted keys (U,) and sums (U, 4).
        half_span = 1 << (_AXIS_BITS - 1)
        usable = (np.abs(points) < half_span * self._voxel_m).all(axis=1)  # False for NaN and infinity
        usable &= np.isfinite(variance_m2) & (variance_m2 > 0.0)
        self._newest_seq = max(self._newest_seq, seq)
        points, weight = points[usable], 1.0 / variance_m2[usable]
        index = np.floor(points / self._voxel_m).astype(np.int64) + half_span
        x, y, z = np.clip(index, 0, 2 * half_span - 1).T  # rounding at the border
        keys, voxel = np.unique((x << (2 * _AXIS_BITS)) | (y << _AXIS_BITS) | z, return_inverse=True)
        columns = (weight, *(weight[:, None] * points).T)
        seen = np.zeros(len(keys), VOXEL)
        seen["key"], seen["frames"], seen["last_seq"] = keys, 1, seq
        seen["sums"] = np.stack([np.bincount(voxel, column, len(keys)) for column in columns], axis=1)
        # 2. Those that are known.
        at = np.searchsorted(self._voxels["key"], keys)
        is_known = np.append(self._voxels["key"], -1)[at] == keys
        known = self._voxels[at[is_known]]
        known["sums"] += seen["sums"][is_known]
        known["frames"] += known["last_seq"] != seq
        known["last_seq"] = np.maximum(known["last_seq"], seq)
        self._voxels[at[is_known]] = known
        # 3. New ones.
        self._voxels = np.insert(self._voxels, at[~is_known], seen[~is_known])
        # 4. Half of too many are dropped: the least confident ones, of equal ones those seen last long ago.
        if len(self) > self._max_voxels:
            order = np.lexsort((self._voxels["last_seq"], self._confidence()))
            dropped = len(order) - self._max_voxels // 2
            self._voxels = self._voxels[np.sort(order[dropped:])]

    def points(self, min_frames: int = 2) -> MapPoints:
        """Return the voxels seen in at least `min_frames` frames, with their mean positions, sorted by key."""
        rows = np.flatnonzero(self._voxels["frames"] >= min_frames)
        sums, age = self._voxels["sums"][rows], self._newest_seq - self._voxels["last_seq"][rows]
        return MapPoints(
            (sums[:, 1:] / sums[:, :1]).astype(np.float32),
            self._confidence()[rows].astype(np.float32),
            self._voxels["frames"][rows],
            np.minimum(age, np.iinfo(np.int32).max).astype(np.int32),
        )

    def _confidence(self) -> Array:
        """Return confidences 0..1: n / (n + 1) for n frames times 1 / (1 + variance of the mean / voxel^2)."""
        frames, weight = self._voxels["frames"].astype(np.float64), self._voxels["sums"][:, 0]
        return np.asarray(frames / (frames + 1.0) * weight / (weight + self._voxel_m**-2))


class ThinnedPath:
    """Vertices at least a step apart, and the end of the path; when there are too many, every second one is dropped."""

    def __init__(self, max_vertices: int, step_m: float) -> None:
        """max_vertices: 2 or more. step_m: spacing at first, which doubles."""
        self._max_vertices, self._step_m = max_vertices, step_m
        self.vertices: list[tuple[float, float]] = []  # x, y, m

    def add(self, x_m: float, y_m: float) -> None:
        """Add the next position; it takes the place of the last one while that is less than a step after another."""
        if len(self.vertices) > 1 and math.dist(*self.vertices[-2:]) < self._step_m:
            self.vertices.pop()
        self.vertices.append((x_m, y_m))
        if len(self.vertices) > self._max_vertices:
            self.vertices, self._step_m = [*self.vertices[:-1:2], self.vertices[-1]], 2 * self._step_m

    def xy(self) -> Array:
        """Return the positions (N, 2) [m]."""
        return np.array(self.vertices, float).reshape(-1, 2)
