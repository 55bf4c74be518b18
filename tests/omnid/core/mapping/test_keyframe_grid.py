"""Grid of keyframes that are added and moved: as one that is drawn at once, and drawn again only if it must be."""

from __future__ import annotations

import numpy as np

from omnid.core.mapping.scan_grid import (
    MAX_LIVE_CELLS,
    OCCUPIED,
    UNKNOWN,
    Grid,
    KeyframeGrid,
    KeyframeScans,
    known_part,
)
from tests.omnid.core.mapping.rooms import OPEN, box, pose, scan_of
from tests.omnid.core.mapping.test_scan_grid import PATH, ROOM, grid_of, near

SCANS = [scan_of(ROOM, T).astype(np.float16) for T in PATH]
T_BASE_RECT = pose(0.1, 0.0, np.pi / 2)


def drawn_at_once(scans: list, poses: np.ndarray) -> Grid:
    return known_part(grid_of([scan.astype(np.float32) for scan in scans], T_BASE_RECT @ poses))


def seen(count: int, poses: np.ndarray = PATH, first: int = 0) -> KeyframeScans:
    return of({7 + n: SCANS[n] for n in range(first, count)}, poses[first:count])


def of(scans: dict[int, np.ndarray], poses: np.ndarray) -> KeyframeScans:
    """Return scans with floor up to what they show."""
    return KeyframeScans(scans, dict.fromkeys(scans, OPEN.astype(np.float16)), poses)


def same(a: Grid, b: Grid) -> bool:
    return a.cell_m == b.cell_m and np.allclose(a.corner, b.corner) and np.array_equal(a.cells, b.cells)


def test_new_keyframes_are_drawn_into_the_grid() -> None:
    grid = KeyframeGrid(0.05)
    for count in range(1, len(PATH) + 1):
        found = grid.draw(seen(count), T_BASE_RECT)
    assert same(found, drawn_at_once(SCANS, PATH)) and grid.redrawn == 1


def test_the_map_moves_when_a_loop_moves_its_keyframes() -> None:
    """By millimetres it stays as it is drawn, a cell further all is drawn again."""
    grid = KeyframeGrid(0.05)
    first = grid.draw(seen(len(PATH)), T_BASE_RECT)
    nearly, closed = pose(0.01, 0.0, 0.001) @ PATH, pose(0.4, -0.2, 0.1) @ PATH
    assert same(grid.draw(seen(len(PATH), nearly), T_BASE_RECT), first) and grid.redrawn == 1
    after = grid.draw(seen(len(PATH), closed), T_BASE_RECT)
    assert same(after, drawn_at_once(SCANS, closed)) and grid.redrawn == 2
    x, y = (T_BASE_RECT @ pose(0.4, -0.2, 0.1) @ [4.0, 0.0, 0, 1])[:2]
    assert OCCUPIED in near(after, x, y)


def test_it_grows_and_is_bounded() -> None:
    grid = KeyframeGrid(0.05)
    nothing = grid.draw(of({}, np.zeros((0, 4, 4))), T_BASE_RECT)
    assert (nothing.cells == UNKNOWN).all()
    far = np.array([PATH[0], pose(3000.0, 4000.0, 0.0) @ PATH[0]])
    found = grid.draw(of({0: SCANS[0], 1: SCANS[0]}, far), T_BASE_RECT)
    assert found.cell_m > 0.05 and found.cells.size <= MAX_LIVE_CELLS and grid.redrawn == 2
    small = scan_of(box((-1, -1), (1, 1)), PATH[0]).astype(np.float16)
    assert same(
        grid.draw(of({0: SCANS[0], 1: SCANS[0], 2: small}, np.array([*far, far[0]])), T_BASE_RECT),
        grid.draw(of({0: SCANS[0], 1: SCANS[0], 2: small}, np.array([*far, far[0]])), T_BASE_RECT),
    )
