"""Voxel map: confidence, refused points, bounded memory, deterministic results."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.mapping.voxel_map import VoxelMap

Array = NDArray[np.float64]


def var(count: int, variance_m2: float = 1e-4) -> Array:
    return np.full(count, variance_m2)


def row(start: int, count: int) -> Array:
    """Return the centres of `count` neighbouring voxels of 1 m."""
    return np.stack([np.arange(start, start + count) + 0.5, np.zeros(count), np.zeros(count)], axis=1)


def test_agrees_with_a_dictionary() -> None:
    rng = np.random.default_rng(5)
    voxels = VoxelMap(voxel_m=0.1, most=4096)
    sums: dict[tuple[int, ...], Array] = {}
    seen: dict[tuple[int, ...], list[int]] = {}
    for seq in range(20):
        points, variance = rng.uniform(-0.6, 0.6, (500, 3)), rng.uniform(1e-4, 1e-2, 500)
        voxels.insert(points, variance, seq)
        for p, v in zip(points, variance, strict=True):
            key = tuple(np.floor(p / 0.1).astype(int))
            sums[key] = sums.get(key, np.zeros(4)) + np.array([1.0, *p]) / v
            seen.setdefault(key, []).append(seq)
    found = voxels.points(min_frames=1)
    keys = sorted(sums)
    assert len(voxels) == len(keys)
    np.testing.assert_allclose(found.xyz, [sums[k][1:] / sums[k][0] for k in keys], atol=1e-6)
    assert found.frames.tolist() == [len(set(seen[k])) for k in keys]
    assert found.age.tolist() == [19 - seen[k][-1] for k in keys]


def test_evicts_old_single_voxels_then_the_least_confident() -> None:
    voxels = VoxelMap(voxel_m=1.0, most=44)
    voxels.insert(row(0, 15), var(15, 1e-8), seq=0)  # precise, but seen once and long ago
    for seq in (100, 101):
        voxels.insert(row(100, 15), var(15, 1e-2), seq)
        voxels.insert(row(200, 10), var(10, 1e2), seq)  # seen as often, but uncertain
    voxels.insert(row(300, 5), var(5, 1e-2), seq=102)  # seen once, just now: 45 voxels
    assert len(voxels) == 30
    survivors = voxels.points(1).xyz[:, 0] // 100
    assert [int((survivors == group).sum()) for group in range(4)] == [0, 15, 10, 5]
    voxels.insert(row(400, 15), var(15, 1e-2), seq=103)
    survivors = voxels.points(1).xyz[:, 0] // 100
    assert [int((survivors == group).sum()) for group in range(5)] == [0, 15, 0, 0, 15]


@pytest.mark.parametrize("most", [16, 64, 1024])
def test_memory_stays_bounded(most: int) -> None:
    rng = np.random.default_rng(2)
    voxels = VoxelMap(voxel_m=0.1, most=most)
    for seq in range(5):
        voxels.insert(rng.uniform(-1e4, 1e4, (3000, 3)), var(3000), seq)
        assert len(voxels) <= most
    assert len(voxels.points(1).xyz) == len(voxels)
