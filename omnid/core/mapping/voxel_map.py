"""Voxel map in bounded memory: points of all frames, in the world frame, fused in voxels.

Dang et al. 2012, section IV.G: points reconstructed at each frame are transformed by the estimated motion into one
frame and merged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnid.errors import OmnidError

_AXIS_BITS = 21  # Bits of a packed key per axis, so that three of them fit the 63 bits of a positive key.
# Voxel indices run from -2^20 to 2^20 - 1 on each axis; because zero is in the middle.
_HALF_SPAN = 1 << (_AXIS_BITS - 1)
_EMPTY = np.int64(-1)  # packed keys are never negative
# Part of the table in use at which voxels are evicted; since a miss takes (1 + 1/0.3^2)/2 = 6 probes there.
_MAX_LOAD = 0.7
_LOAD_AFTER_EVICTION = 0.5  # A fifth of the table is filled between two evictions, so that they are rare.
_BATCHES = 8  # At most 1/8 of the table is placed at once: the load stays below 0.7 + 0.125, so probing ends.
# A voxel seen once and not again for this number of frames is most likely a false match; by trial on development seeds.
# A count and no time, as the age of a point, because each frame is another look.
_OLD_FRAMES = 30
_VARIANCE_RANGE_M2 = (1e-8, 1e8)  # standard deviations of 0.1 mm to 10 km, so that sums of weights cannot overflow
_BLOCK_POINTS = 4096  # Points of a snapshot that are computed at a time, so that it needs little extra memory.
_HASH = np.uint64(0x9E3779B97F4A7C15)  # 2^64 / golden ratio; source: Knuth's multiplicative hash


@dataclass(frozen=True, slots=True)
class MapPoints:
    """A snapshot of the map, sorted by voxel; world frame."""

    xyz: NDArray[np.float32]  # (M, 3) m
    confidence: NDArray[np.float32]  # (M,) 0..1
    frames: NDArray[np.int32]  # (M,) frames that saw the voxel
    age: NDArray[np.int32]  # (M,) seqs since it was last seen


class VoxelMap:
    """Hash table of voxels in preallocated arrays of 52 bytes per slot.

    Each voxel keeps the mean position weighted by information (1 / variance), its sum of weights, the number of frames
    that saw it and the last of them. `evicted` counts voxels dropped for space, `refused` points that were not mapped:
    not finite, of no valid variance, or outside +-2^20 voxels.
    """

    def __init__(self, voxel_m: float = 0.05, capacity: int = 1 << 18) -> None:
        if not (np.isfinite(voxel_m) and voxel_m > 0.0):
            raise OmnidError(f"voxel edge: expected a length above 0 m, such as 0.05, found {voxel_m}")
        if capacity < 16 or capacity & (capacity - 1):
            raise OmnidError(f"capacity: expected a power of two from 16 on, such as {1 << 18}, found {capacity}")
        self.evicted = 0
        self.refused = 0
        self._voxel_m = voxel_m
        self._shift = np.uint64(65 - capacity.bit_length())  # the top bits of a multiplicative hash are the best mixed
        self._count = 0
        self._newest_seq = 0
        self._keys = np.full(capacity, _EMPTY, dtype=np.int64)
        self._sums = np.zeros((capacity, 4))  # information, and information times x, y, z
        self._frames = np.zeros(capacity, dtype=np.int32)
        self._last_seq = np.zeros(capacity, dtype=np.int64)

    def __len__(self) -> int:
        return self._count

    def insert(self, points: NDArray[np.float64], variance_m2: NDArray[np.float64], seq: int) -> None:
        """Fuse the points (N, 3) of frame `seq`, in metres in the world frame, with their isotropic variances (N,)."""
        usable = self._usable(points, variance_m2)
        self.refused += len(points) - int(usable.sum())
        keys, sums = self._reduce(points[usable], variance_m2[usable])
        self._newest_seq = max(self._newest_seq, seq)
        batch = len(self._keys) // _BATCHES
        for start in range(0, len(keys), batch):
            self._fuse(keys[start : start + batch], sums[start : start + batch], seq)
            if self._count > _MAX_LOAD * len(self._keys):
                self._evict()

    def points(self, min_frames: int = 2) -> MapPoints:
        """Return the voxels seen in at least `min_frames` frames, with their mean positions, sorted by key."""
        slots = np.flatnonzero(self._frames >= max(1, min_frames))  # empty slots have none
        slots = slots[np.argsort(self._keys[slots])]
        count = len(slots)
        points = MapPoints(
            np.empty((count, 3), np.float32),
            np.empty(count, np.float32),
            self._frames[slots],
            np.empty(count, np.int32),
        )
        for start in range(0, count, _BLOCK_POINTS):
            at = slice(start, start + _BLOCK_POINTS)
            self._describe(slots[at], points.xyz[at], points.confidence[at], points.age[at])
        return points

    def _describe(self, slots: NDArray[np.int64], *into: NDArray[np.generic]) -> None:
        """Write mean positions (N, 3), confidence (N,) and age (N,) of some slots into arrays."""
        sums = self._sums[slots]
        age = self._newest_seq - self._last_seq[slots]
        found = (sums[:, 1:] / sums[:, :1], self._confidence(slots), np.minimum(age, np.iinfo(np.int32).max))
        for target, values in zip(into, found, strict=True):
            target[...] = values

    def _usable(self, points: NDArray[np.float64], variance_m2: NDArray[np.float64]) -> NDArray[np.bool_]:
        inside = (np.abs(points) < _HALF_SPAN * self._voxel_m).all(axis=1)  # False for NaN and infinity
        return np.asarray(inside & np.isfinite(variance_m2) & (variance_m2 > 0.0))

    def _reduce(
        self, points: NDArray[np.float64], variance_m2: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the voxels of one frame: sorted packed keys (U,) and sums (U, 4)."""
        keys, voxel = np.unique(self._pack(points), return_inverse=True)
        weight = 1.0 / np.clip(variance_m2, *_VARIANCE_RANGE_M2)
        columns = (weight, *(weight[:, None] * points).T)
        return keys, np.stack([np.bincount(voxel, column, len(keys)) for column in columns], axis=1)

    def _pack(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        index = np.floor(points / self._voxel_m).astype(np.int64) + _HALF_SPAN
        index = np.clip(index, 0, 2 * _HALF_SPAN - 1)  # rounding at the border
        return np.asarray((index[:, 0] << (2 * _AXIS_BITS)) | (index[:, 1] << _AXIS_BITS) | index[:, 2])

    def _fuse(self, keys: NDArray[np.int64], sums: NDArray[np.float64], seq: int) -> None:
        slots = self._place(keys)
        known = self._frames[slots] > 0
        self._count += int(len(keys) - known.sum())
        self._sums[slots] += sums
        self._frames[slots] += ~known | (self._last_seq[slots] != seq)
        self._last_seq[slots] = np.where(known, np.maximum(self._last_seq[slots], seq), seq)

    def _place(self, keys: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the slot of each of the distinct keys; free slots are claimed.

        Triangular probing visits every slot of a table of 2^n, and the table is never full: the loop ends.
        """
        slots = (keys.view(np.uint64) * _HASH >> self._shift).astype(np.int64)
        pending = np.arange(len(keys))
        step = 0
        while pending.size:
            tried = slots[pending]
            free = self._keys[tried] == _EMPTY
            self._keys[tried[free]] = keys[pending[free]]  # of two keys for one slot, the last one stays
            pending = pending[self._keys[tried] != keys[pending]]
            step += 1
            slots[pending] = (slots[pending] + step) & (len(self._keys) - 1)
        return slots

    def _confidence(self, slots: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return confidences 0..1: n / (n + 1) for n frames times 1 / (1 + variance of the mean / voxel^2)."""
        frames, weight = self._frames[slots].astype(np.float64), self._sums[slots, 0]
        return np.asarray(frames / (frames + 1.0) * weight / (weight + self._voxel_m**-2))

    def _evict(self) -> None:
        """Drop voxels down to _LOAD_AFTER_EVICTION: those seen once and long ago first, then the least confident."""
        slots = np.flatnonzero(self._keys != _EMPTY)
        old_single = (self._frames[slots] == 1) & (self._newest_seq - self._last_seq[slots] > _OLD_FRAMES)
        # The key makes the order of ties deterministic.
        order = np.lexsort((self._keys[slots], self._confidence(slots), ~old_single))
        kept = slots[order[len(slots) - int(_LOAD_AFTER_EVICTION * len(self._keys)) :]]
        self.evicted += len(slots) - len(kept)
        self._rebuild(kept)

    def _rebuild(self, kept: NDArray[np.int64]) -> None:
        keys, sums = self._keys[kept], self._sums[kept]
        frames, last_seq = self._frames[kept], self._last_seq[kept]
        self._keys.fill(_EMPTY)
        self._frames.fill(0)
        self._sums.fill(0.0)
        slots = self._place(keys)
        self._sums[slots], self._frames[slots], self._last_seq[slots] = sums, frames, last_seq
        self._count = len(kept)
