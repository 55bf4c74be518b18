"""Voxel map: fusion by information, frame counts, bounded memory, deterministic results."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.mapping.voxel_map import MapPoints, VoxelMap
from omnid.errors import OmnidError
from tests.omnid.allocations import taken

Array = NDArray[np.float64]


def one(x: float, y: float, z: float) -> Array:
    return np.array([[x, y, z]])


def var(count: int, variance_m2: float = 1e-4) -> Array:
    return np.full(count, variance_m2)


def row(start: int, count: int) -> Array:
    """Return the centres of `count` neighbouring voxels of 1 m."""
    return np.stack([np.arange(start, start + count) + 0.5, np.zeros(count), np.zeros(count)], axis=1)


def as_bytes(points: MapPoints) -> bytes:
    return b"".join(a.tobytes() for a in (points.xyz, points.confidence, points.frames, points.age))


def test_mean_is_weighted_by_information() -> None:
    voxels = VoxelMap(voxel_m=1.0, capacity=64)
    voxels.insert(one(0.2, -0.5, 7.5), np.array([0.01]), seq=1)
    voxels.insert(one(0.6, -0.1, 7.5), np.array([0.03]), seq=2)
    points = voxels.points()
    np.testing.assert_allclose(points.xyz, [[0.3, -0.4, 7.5]], atol=1e-6)
    assert (points.frames.tolist(), points.age.tolist()) == ([2], [0])


def test_counts_a_frame_once() -> None:
    voxels = VoxelMap(voxel_m=1.0, capacity=64)
    voxels.insert(np.repeat(one(0.5, 0.5, 0.5), 100, axis=0), var(100), seq=4)
    voxels.insert(one(0.1, 0.5, 0.5), var(1), seq=4)
    assert len(voxels) == 1 and voxels.points(min_frames=2).xyz.shape == (0, 3)
    assert voxels.points(min_frames=1).frames.tolist() == [1]
    assert voxels.points(min_frames=1).xyz[0, 0] == pytest.approx(50.1 / 101)


def test_agrees_with_a_dictionary() -> None:
    rng = np.random.default_rng(5)
    voxels = VoxelMap(voxel_m=0.1, capacity=4096)
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
    assert len(voxels) == len(keys) and (voxels.evicted, voxels.refused) == (0, 0)
    np.testing.assert_allclose(found.xyz, [sums[k][1:] / sums[k][0] for k in keys], atol=1e-6)
    assert found.frames.tolist() == [len(set(seen[k])) for k in keys]
    assert found.age.tolist() == [19 - seen[k][-1] for k in keys]


def test_min_frames_and_age() -> None:
    voxels = VoxelMap(voxel_m=1.0, capacity=64)
    for seq in range(10):
        voxels.insert(row(0, 3 if seq < 4 else 1), var(3 if seq < 4 else 1), seq)
    assert voxels.points(5).age.tolist() == [0]
    assert voxels.points(4).age.tolist() == [0, 6, 6]
    voxels.insert(row(0, 2), var(2), 7)  # a late frame
    assert voxels.points(4).age.tolist() == [0, 2, 6]


def test_confidence_grows_with_frames_and_precision() -> None:
    voxels = VoxelMap(voxel_m=0.05, capacity=64)
    history = []
    for seq in range(6):
        voxels.insert(one(0.01, 0.01, 0.01), var(1, 1e-3), seq)
        history.append(float(voxels.points(1).confidence[0]))
    assert history == sorted(set(history)) and 0.0 < history[0] < 0.5 and history[-1] < 1.0
    sharp = VoxelMap(voxel_m=0.05, capacity=64)
    sharp.insert(one(0.01, 0.01, 0.01), var(1, 1e-5), 0)
    assert sharp.points(1).confidence[0] > history[0]


def test_counts_refused_points_and_leaves_them_out() -> None:
    voxels = VoxelMap(voxel_m=1.0, capacity=64)
    points = np.repeat(one(0.5, 0.5, 0.5), 9, axis=0)
    points[0, 1], points[1, 2], points[2, 0], points[3, 0] = np.nan, np.inf, float(1 << 20), -1e300
    variance = var(9)
    variance[4:8] = [0.0, -1.0, np.nan, np.inf]
    voxels.insert(points, variance, 0)
    assert (voxels.refused, len(voxels)) == (8, 1)


def test_maps_the_corners_of_its_range() -> None:
    voxels = VoxelMap(voxel_m=1.0, capacity=64)
    edge = float(1 << 20)
    corners = np.array([[s * (edge - 0.5) for s in signs] for signs in np.ndindex(2, 2, 2)]) * 2 - edge + 0.5
    voxels.insert(np.vstack([corners, np.nextafter(-edge, 0.0) * np.ones((1, 3))]), var(9), 0)
    assert (voxels.refused, len(voxels)) == (0, 8)


def test_inserts_an_empty_frame() -> None:
    voxels = VoxelMap()
    voxels.insert(np.empty((0, 3)), np.empty(0), 0)
    points = voxels.points()
    assert len(voxels) == 0 and points.xyz.shape == (0, 3) and points.xyz.dtype == np.float32


def test_tiny_variance_does_not_overflow() -> None:
    voxels = VoxelMap(voxel_m=1.0, capacity=64)
    voxels.insert(row(0, 2), np.array([1e-320, 1e300]), 0)
    points = voxels.points(1)
    np.testing.assert_allclose(points.xyz[:, 0], [0.5, 1.5])
    assert ((points.confidence > 0.0) & (points.confidence < 1.0)).all()


def test_evicts_old_single_voxels_then_the_least_confident() -> None:
    voxels = VoxelMap(voxel_m=1.0, capacity=64)
    voxels.insert(row(0, 15), var(15, 1e-8), seq=0)  # precise, but seen once and long ago
    for seq in (100, 101):
        voxels.insert(row(100, 15), var(15, 1e-2), seq)
        voxels.insert(row(200, 10), var(10, 1e2), seq)  # seen as often, but uncertain
    voxels.insert(row(300, 5), var(5, 1e-2), seq=102)  # seen once, just now: 45 voxels, more than 0.7 * 64
    assert (voxels.evicted, len(voxels)) == (13, 32)
    survivors = voxels.points(1).xyz[:, 0] // 100
    assert [int((survivors == group).sum()) for group in range(4)] == [2, 15, 10, 5]
    voxels.insert(row(400, 13), var(13, 1e-2), seq=103)
    survivors = voxels.points(1).xyz[:, 0] // 100
    assert voxels.evicted == 26 and [int((survivors == group).sum()) for group in range(5)] == [0, 15, 0, 4, 13]


@pytest.mark.parametrize("capacity", [16, 64, 1024])
def test_memory_stays_bounded(capacity: int) -> None:
    rng = np.random.default_rng(2)
    voxels = VoxelMap(voxel_m=0.1, capacity=capacity)
    for seq in range(5):
        voxels.insert(rng.uniform(-1e4, 1e4, (3000, 3)), var(3000), seq)
        assert len(voxels) <= 0.7 * capacity
    assert len(voxels) + voxels.evicted == 15_000
    assert len(voxels.points(1).xyz) == len(voxels)


def test_keeps_voxels_that_are_seen_again() -> None:
    rng = np.random.default_rng(4)
    voxels = VoxelMap(voxel_m=1.0, capacity=1024)
    for seq in range(200):
        voxels.insert(row(0, 100), var(100), seq)
        voxels.insert(rng.uniform(-1e5, 1e5, (50, 3)), var(50), seq)
    assert voxels.evicted > 5000
    points = voxels.points(200)
    np.testing.assert_allclose(points.xyz, row(0, 100), atol=1e-4)


def test_same_input_gives_the_same_bytes() -> None:
    def run() -> VoxelMap:
        rng = np.random.default_rng(9)
        voxels = VoxelMap(voxel_m=0.1, capacity=512)
        for seq in range(30):
            voxels.insert(rng.normal(0.0, 1.0, (300, 3)), rng.uniform(1e-4, 1e-2, 300), seq)
        return voxels

    first, second = run(), run()
    assert first.evicted == second.evicted > 0
    assert as_bytes(first.points(1)) == as_bytes(second.points(1)) != b""


def test_snapshot_is_a_copy() -> None:
    voxels = VoxelMap(voxel_m=1.0, capacity=64)
    voxels.insert(row(0, 3), var(3), 0)
    before = voxels.points(1)
    kept = as_bytes(before)
    voxels.insert(row(0, 3) + 0.3, var(3), 1)
    assert as_bytes(before) == kept


def test_a_snapshot_needs_little_extra_memory() -> None:
    """A live run takes one every two seconds for hours; its peak memory stays with the process."""
    rng = np.random.default_rng(3)
    voxels = VoxelMap(voxel_m=0.05)
    voxels.insert(rng.uniform(-4.0, 4.0, (100_000, 3)), var(100_000), 0)
    most, held = taken(lambda: voxels.points(1))
    assert held > 20 * len(voxels) and most < 1.75 * held


@pytest.mark.parametrize("count", [4095, 4096, 4097, 8193])
def test_a_snapshot_has_all_points_of_several_blocks(count: int) -> None:
    voxels = VoxelMap(voxel_m=1.0)
    voxels.insert(row(0, count), var(count), 0)
    points = voxels.points(1)
    np.testing.assert_array_equal(points.xyz, row(0, count).astype(np.float32))
    assert (points.age == 0).all() and len(set(points.confidence.tolist())) == 1 and points.confidence[0] > 0


@pytest.mark.parametrize(("voxel_m", "capacity"), [(0.0, 64), (np.nan, 64), (-1.0, 64), (0.1, 0), (0.1, 100), (0.1, 8)])
def test_refuses_wrong_settings(voxel_m: float, capacity: int) -> None:
    with pytest.raises(OmnidError, match="expected"):
        VoxelMap(voxel_m, capacity)
