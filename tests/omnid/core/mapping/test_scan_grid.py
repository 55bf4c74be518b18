"""Grid of range scans: walls, free space, what has gone is cleared, and the map moves with its keyframes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnid.core.mapping.range_scan import SECTORS, FreeRanges, RangeScan, azimuths, seen_from
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


def test_what_no_scan_shows_is_free_nowhere_as_its_floor_is_not_seen() -> None:
    """All scans pass over a low box; views pass through the space above it."""
    path = np.array([pose(x, 0, 0) for x in np.arange(-2.5, 7.0, 0.3)])
    walls, low = box((-3.5, -2.0), (8.0, 2.0)), box((0.0, 1.0), (0.4, 1.4))
    free_m = [np.minimum(seen_from(scan_of(np.concatenate([walls, low]), T), np.eye(4)), 3.0) for T in path]
    grid = scan_grid([scan_of(walls, T) for T in path], free_m, path)
    inside = [(x, y) for x in np.arange(0.02, 0.4, 0.05) for y in np.arange(1.02, 1.4, 0.05)]
    assert {at(grid, x, y) for x, y in inside} == {UNKNOWN}
    assert {at(grid, x, 0.0) for x in np.arange(-2.5, 6.5, 0.1)} == {FREE}


def test_a_pole_thinner_than_a_cell_that_shows_no_range_is_not_free() -> None:
    """A plain pole shows no range: those beside it pass it by half a cell."""
    path = np.array([pose(x, 0, 0) for x in np.arange(-1.5, 1.5, 0.3)])
    scans = []
    for T in path:
        scan = scan_of(ROOM, T)
        off = np.arctan2(1.0, 0.2 - T[0, 3]) - azimuths()
        scan[np.abs(off) < np.arctan2(0.02, np.hypot(1.0, 0.2 - T[0, 3])) + np.deg2rad(0.5)] = np.nan
        scans.append(scan)
    for cell_m in (0.02, 0.05):
        grid = grid_of(scans, path, cell_m)
        assert FREE not in {at(grid, 0.2 + dx, 1.0 + dy) for dx in (-0.01, 0.01) for dy in (-0.01, 0.01)}
        assert at(grid, 0.2, 0.5) == at(grid, 0.2, 0.0) == FREE


def test_views_that_something_narrow_ends_outvote_those_that_have_missed_it() -> None:
    """A pole at (0.2, 1): three of ten views miss it, and one sees something narrow where nothing stands."""
    path, scans, free_m = np.array([pose(x, 0, 0) for x in np.arange(-1.3, 1.7, 0.3)]), [], []
    for n, T in enumerate(path):
        free = OPEN.copy()
        if n % 4:
            range_m = np.hypot(1.0, 0.2 - T[0, 3])
            hidden = np.abs(np.arctan2(1.0, 0.2 - T[0, 3]) - azimuths()) < 0.02 / range_m + np.deg2rad(0.5)
            free[hidden] = -(range_m - 0.1)
        scans.append(scan_of(ROOM, T))
        free_m.append(free)
    free_m[5][90] = -1.2  # to the right
    grid = scan_grid(scans, free_m, path)
    assert {at(grid, 0.2 + dx, 1.0 + dy) for dx in (-0.02, 0.02) for dy in (-0.02, 0.02)} == {UNKNOWN}
    assert {at(grid, 0.2 + dx, 1.0) for dx in (-0.3, 0.3)} | {at(grid, 0.2, y) for y in (0.7, 1.5)} == {FREE}
    assert {at(grid, path[5, 0, 3], y) for y in np.arange(-1.6, -0.5, 0.05)} == {FREE}


def test_what_is_narrow_is_cleared_by_near_views_that_pass_it_and_not_by_far_ones() -> None:
    near_view, far_view = pose(0.2, 0, 0), pose(2.4, -0.9, 0)  # 1.2 m and 3 m from a pole at (0.2, 1.2)
    ended = OPEN.copy()
    ended[SECTORS * 3 // 4 - 2 : SECTORS * 3 // 4 + 2] = -1.1  # to the left
    seen = [(near_view, ended)] * 2 + [(far_view, OPEN)] * 9
    for more, expected in ((0, UNKNOWN), (1, FREE)):
        views = seen + [(near_view, OPEN)] * more
        path = np.array([T for T, _ in views])
        grid = scan_grid([scan_of(ROOM, T) for T in path], [free for _, free in views], path)
        assert at(grid, 0.2, 1.2) == expected and at(grid, 0.2, 0.8) == FREE


def test_no_scan_is_no_map_and_a_large_area_gets_larger_cells() -> None:
    assert set(grid_of([], np.zeros((0, 4, 4))).cells.ravel()) == {UNKNOWN}
    far = np.array([pose(0, 0, 0), pose(900, 300, 0)])
    grid = grid_of([scan_of(ROOM, far[0])] * 2, far)
    assert grid.cells.size <= MAX_CELLS and grid.cell_m == 0.2


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


def test_it_grows_and_is_bounded() -> None:
    grid = KeyframeGrid(0.05)
    nothing = grid.draw(of({}, np.zeros((0, 4, 4))), T_BASE_RECT)
    assert (nothing.cells == UNKNOWN).all()
    far = np.array([PATH[0], pose(3000.0, 4000.0, 0.0) @ PATH[0]])
    found = grid.draw(of({0: SCANS[0], 1: SCANS[0]}, far), T_BASE_RECT)
    assert found.cell_m > 0.05 and found.cells.size <= MAX_LIVE_CELLS
    small = scan_of(box((-1, -1), (1, 1)), PATH[0]).astype(np.float16)
    assert same(
        grid.draw(of({0: SCANS[0], 1: SCANS[0], 2: small}, np.array([*far, far[0]])), T_BASE_RECT),
        grid.draw(of({0: SCANS[0], 1: SCANS[0], 2: small}, np.array([*far, far[0]])), T_BASE_RECT),
    )
