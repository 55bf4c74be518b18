"""Range scans of points, grids of scans, and the voxel map: what they show, what is cleared, their bounds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from calib import se3
from omnid.core.mapping.range_scan import FreeRanges, RangeScan, azimuths, point_scan, seen_from
from omnid.core.mapping.scan_grid import (
    FREE,
    MAX_CELLS,
    MAX_LIVE_CELLS,
    OCCUPIED,
    UNKNOWN,
    Grid,
    KeyframeGrid,
    KeyframeScans,
)
from omnid.core.mapping.voxel_map import VoxelMap
from tests.omnid.core.mapping.rooms import OPEN, Array, box, pose, scan_of

ROOM = box((-3.0, -2.0), (4.0, 2.5))
PATH = np.array([pose(x, 0.2 * x, 0.3 * x) for x in np.arange(-1.5, 1.5, 0.3)])


def scan_grid(scans: Sequence[RangeScan], free_m: Sequence[FreeRanges], poses: Array, cell_m: float = 0.05) -> Grid:
    """Return the grid of scans that are drawn at once."""
    first, second = ({n: each.astype(np.float16) for n, each in enumerate(ranges)} for ranges in (scans, free_m))
    return KeyframeGrid(cell_m, MAX_CELLS).draw(KeyframeScans(first, second, poses), np.eye(4))


def grid_of(scans: Sequence[RangeScan], poses: Array, cell_m: float = 0.05) -> Grid:
    """Return the grid of scans with floor up to what they show."""
    return scan_grid(scans, [OPEN] * len(scans), poses, cell_m)


def at(grid: Grid, x: float, y: float) -> int:
    column, row = (
        int(np.floor(value / grid.cell_m)) - round(corner / grid.cell_m)
        for value, corner in zip((x, y), grid.corner, strict=True)
    )
    height, width = grid.cells.shape
    return int(grid.cells[row, column]) if 0 <= row < height and 0 <= column < width else UNKNOWN


def near(grid: Grid, x: float, y: float) -> set[int]:
    """Return the values of a cell and its eight neighbours."""
    return {at(grid, x + dx, y + dy) for dx in (-0.05, 0, 0.05) for dy in (-0.05, 0, 0.05)}


def test_walls_are_occupied_the_room_is_free_the_rest_unknown() -> None:
    grid = grid_of([scan_of(ROOM, T, 0.01, n) for n, T in enumerate(PATH)], PATH)
    for y in np.arange(-1.9, 2.4, 0.1):
        assert OCCUPIED in near(grid, -3.0, y) and OCCUPIED in near(grid, 4.0, y)
        assert {at(grid, x, y) for x in np.arange(-2.7, 3.55, 0.1)} == {FREE} or abs(y - 0.25) > 1.9
        assert at(grid, -3.3, y) == at(grid, 4.3, y) == UNKNOWN


def test_an_obstacle_that_has_gone_is_cleared_and_a_new_one_appears() -> None:
    T = np.tile(pose(0, 0, 0), (30, 1, 1))
    before, after = np.concatenate([ROOM, box((1, 1), (1.3, 1.3))]), np.concatenate([ROOM, box((1, -1), (1.3, -0.7))])
    scans = [scan_of(before, T[0])] * 18 + [scan_of(after, T[0])] * 12
    grid = grid_of(scans[:18], T[:18])
    assert OCCUPIED in near(grid, 1.0, 1.0) and at(grid, 1.0, -0.7) == FREE
    grid = grid_of(scans, T)
    assert near(grid, 1.0, 1.0) == {FREE} and OCCUPIED in near(grid, 1.0, -0.7)


def test_floor_that_no_scan_shows_is_not_free() -> None:
    """All scans pass over a low box; views pass through the space above it."""
    path = np.array([pose(x, 0, 0) for x in np.arange(-2.5, 7.0, 0.3)])
    walls, low = box((-3.5, -2.0), (8.0, 2.0)), box((0.0, 1.0), (0.4, 1.4))
    free_m = [np.minimum(seen_from(scan_of(np.concatenate([walls, low]), T), np.eye(4)), 3.0) for T in path]
    grid = scan_grid([scan_of(walls, T) for T in path], free_m, path)
    inside = [(x, y) for x in np.arange(0.02, 0.4, 0.05) for y in np.arange(1.02, 1.4, 0.05)]
    assert {at(grid, x, y) for x, y in inside} == {UNKNOWN}
    assert {at(grid, x, 0.0) for x in np.arange(-2.5, 6.5, 0.1)} == {FREE}


# The grid of keyframes that are added and moved: as one that is drawn at once, and drawn again only if it must be.
SCANS = [scan_of(ROOM, T) for T in PATH]
T_BASE_RECT = pose(0.1, 0.0, np.pi / 2)


def drawn_at_once(scans: Sequence[RangeScan], poses: np.ndarray) -> Grid:
    return grid_of(scans, T_BASE_RECT @ poses)


def seen(count: int, poses: np.ndarray = PATH, first: int = 0) -> KeyframeScans:
    return of({7 + n: SCANS[n].astype(np.float16) for n in range(first, count)}, poses[first:count])


def of(scans: dict[int, np.ndarray], poses: np.ndarray) -> KeyframeScans:
    """Return scans with floor up to what they show."""
    return KeyframeScans(scans, dict.fromkeys(scans, OPEN.astype(np.float16)), poses)


def same(a: Grid, b: Grid) -> bool:
    return a.cell_m == b.cell_m and np.allclose(a.corner, b.corner) and np.array_equal(a.cells, b.cells)


def test_the_map_moves_when_a_loop_moves_its_keyframes() -> None:
    """By millimetres it stays as it is drawn, a cell further all is drawn again."""
    grid = KeyframeGrid(0.05)
    first = grid.draw(seen(len(PATH)), T_BASE_RECT)
    nearly, closed = pose(0.01, 0.0, 0.001) @ PATH, pose(0.4, -0.2, 0.1) @ PATH
    assert same(grid.draw(seen(len(PATH), nearly), T_BASE_RECT), first)
    after = grid.draw(seen(len(PATH), closed), T_BASE_RECT)
    assert same(after, drawn_at_once(SCANS, closed))
    x, y = (T_BASE_RECT @ pose(0.4, -0.2, 0.1) @ [4.0, 0.0, 0, 1])[:2]
    assert OCCUPIED in near(after, x, y)


def test_the_grid_grows_and_is_bounded() -> None:
    grid = KeyframeGrid(0.05)
    empty = grid.draw(of({}, np.zeros((0, 4, 4))), T_BASE_RECT)
    assert (empty.cells == UNKNOWN).all()
    far = np.array([PATH[0], pose(3000.0, 4000.0, 0.0) @ PATH[0]])
    found = grid.draw(of({0: SCANS[0], 1: SCANS[0]}, far), T_BASE_RECT)
    assert found.cell_m > 0.05 and found.cells.size <= MAX_LIVE_CELLS


FLOOR_M = -1.2
VIEW = np.zeros(3)


def scan_seen(*parts: np.ndarray, sigma_of_m2: float = 0.01) -> np.ndarray:
    """Return the scan of points, whose sigma is so many metres per square metre of range."""
    points = np.vstack(parts)
    above_floor = points - [0.0, 0.0, FLOOR_M]
    limits = (0.06, 1.7), np.radians(0.5), 6
    return point_scan(above_floor, sigma_of_m2 * (points**2).sum(axis=1), VIEW - [0.0, 0.0, FLOOR_M], *limits)


def arc(range_m: float, degrees: tuple[float, float], heights_m: tuple[float, float], count: int = 2000) -> np.ndarray:
    """Return points of an upright cylinder about the base."""
    rng = np.random.default_rng(1)
    angle, z = np.deg2rad(rng.uniform(*degrees, count)), rng.uniform(*heights_m, count)
    return np.column_stack([range_m * np.cos(angle), range_m * np.sin(angle), z])


def floor_points(longest_m: float, degrees: tuple[float, float] = (-180, 180), z_m: float = FLOOR_M) -> np.ndarray:
    """Return points of the floor."""
    rng = np.random.default_rng(2)
    angle, r = np.deg2rad(rng.uniform(*degrees, 60_000)), rng.uniform(0.8, longest_m, 60_000)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(60_000, z_m)])


def within(low_deg: float, high_deg: float) -> np.ndarray:
    """Return which sectors lie between two azimuths."""
    degrees = np.rad2deg(azimuths())
    return (degrees > low_deg) & (degrees < high_deg)


def test_a_wall_is_found_at_its_range_and_elsewhere_nothing_is_known() -> None:
    scan = scan_seen(arc(2.0, (-30, 30), (-0.8, 0.6)))
    np.testing.assert_allclose(scan[within(-29, 29)], 2.0, atol=1e-3)
    assert np.isnan(scan[~within(-32, 32)]).all()


def test_a_floor_with_noise_and_tilt_is_no_obstacle_at_any_range() -> None:
    rng = np.random.default_rng(3)
    ground = floor_points(6.0, z_m=-1.2)
    r = np.linalg.norm(ground, axis=1)
    noisy = ground * (1 + 0.01 * r * rng.standard_normal(len(r)))[:, None]
    tilted = noisy + np.outer(np.tan(np.deg2rad(0.7)) * ground[:, 0], [0, 0, 1])
    scan = scan_seen(tilted)
    assert np.isfinite(scan).sum() <= 2


def test_a_box_before_a_wall_is_found_although_most_points_are_of_the_wall() -> None:
    scan = scan_seen(arc(3.0, (-60, 60), (-0.9, 0.7), 20_000), arc(1.4, (-5, 5), (-0.9, -0.6), 150))
    np.testing.assert_allclose(scan[within(-4, 4)], 1.4, atol=0.02)
    np.testing.assert_allclose(scan[within(8, 50)], 3.0, atol=0.02)


@pytest.mark.parametrize(("gap", "far_m", "is_filled"), [(4, 3.0, True), (5, 3.0, False), (4, 5.0, False)])
def test_short_gaps_of_one_surface_are_filled(gap: int, far_m: float, is_filled: bool) -> None:
    """Across the seam between the last sector and the first."""
    scan = scan_seen(arc(3.0, (120, 178), (-0.9, 0.7)), arc(far_m, (gap - 182, -120), (-0.9, 0.7)))
    assert np.isfinite(scan[[-2, -1, 0, 1]]).all() == is_filled
    if is_filled:
        np.testing.assert_allclose(scan[[-2, -1, 0, 1]], 3.0, atol=0.02)


def test_free_ranges_of_a_base_are_those_of_the_room_from_a_turned_viewpoint_on_it() -> None:
    """They are never longer, and at most 0.15 m shorter than those to flat walls."""
    room, T_base_view = box((-2.0, -1.5), (2.5, 1.5)), pose(0.2, -0.1, np.deg2rad(35))
    found = seen_from(scan_of(room, np.eye(4)), se3.inverse(T_base_view))
    true = scan_of(room, T_base_view)
    assert (found < true + 0.02).all() and (found > true - 0.15).all()


def var(count: int, variance_m2: float = 1e-4) -> Array:
    return np.full(count, variance_m2)


def row(start: int, count: int) -> Array:
    """Return the centres of `count` neighbouring voxels of 1 m."""
    return np.stack([np.arange(start, start + count) + 0.5, np.zeros(count), np.zeros(count)], axis=1)


def test_the_voxel_map_agrees_with_a_dictionary() -> None:
    rng = np.random.default_rng(5)
    voxels = VoxelMap(voxel_m=0.1, max_voxels=4096)
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


def test_the_least_confident_voxels_are_evicted_and_the_oldest_of_these() -> None:
    voxels = VoxelMap(voxel_m=1.0, max_voxels=44)
    voxels.insert(row(0, 15), var(15, 1e-2), seq=0)  # seen once and long ago
    for seq in (100, 101):
        voxels.insert(row(100, 15), var(15, 1e-2), seq)
        voxels.insert(row(200, 10), var(10, 1e2), seq)  # seen as often, but uncertain
    voxels.insert(row(300, 5), var(5, 1e-2), seq=102)  # seen once, just now: 45 voxels
    assert len(voxels) == 22
    survivors = voxels.points(1).xyz[:, 0] // 100
    assert [int((survivors == group).sum()) for group in range(4)] == [2, 15, 0, 5]
