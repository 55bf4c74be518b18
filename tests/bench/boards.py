"""Board detection in hard renderings: `python -m tests.bench.boards [--seed 1] [--count 50]`.

Each image is made of a number, with exact corners: mirrors and fisheyes, walls that look like boards, shadow, noise. A
board is found if all its corners are near the true ones, and wrong if one is not: a wrong board corrupts a calibration
without notice. omnid's detector is also applied to the same scenes without the board, where every detection
is wrong.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import Board
from calib.boards.checkerboard import find_board
from calib.models.camera import Array, Mask, OmniCamera
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera
from omnid.simulation.rendering import textures
from omnid.simulation.rendering.sensor import MountedSensor, Sensor
from tests.bench.results import ResultTable, columns, run
from tests.simulation.boards import BoardRenderer, board_pose, in_view, six_walls

Random = np.random.Generator
Image = NDArray[np.uint8]
SIZES = ((480, 480), (640, 480), (768, 768), (800, 600), (1024, 768), (1280, 960))
BOARDS = ((6, 7), (4, 3), (8, 11), (5, 4), (9, 6), (7, 5))
MIRRORS = ("parabolic", "hyperbolic", "fisheye")
WALLS = ("clouds", "brick", "tiles", "windows", "chequers", "stripes", "page", "granite")
SQUARE_M = 0.03
# Range of the squares' median side, and least side of any square.
SQUARE_PX, LEAST_PX = (5.0, 45.0), 3.0
TRIES = 4000
BEHIND_THE_WALLS = se3.transform(np.eye(3), [0.0, 0.0, 100.0])


@dataclass(frozen=True, slots=True)
class HardBoard:
    """An image of a board, an image of the same place without it, and the ground truth."""

    name: str
    board: Board
    image: Image
    empty: Image
    corners: Array  # (N, 2) px


def render_hard_board(seed: int, number: int) -> HardBoard:
    """Render the image of that number: mirror, walls and board alternate, all else is random."""
    rng = np.random.default_rng([seed, number])
    kind, walls = MIRRORS[number % len(MIRRORS)], WALLS[number % len(WALLS)]
    size, board = SIZES[rng.integers(len(SIZES))], Board(*BOARDS[number % len(BOARDS)], SQUARE_M)
    camera, mask = _camera(rng, kind, size)
    renderer, sensor = BoardRenderer.of(board, camera, mask), _sensor(rng)
    radius_m = rng.uniform(1.2, 3.5)
    painted = six_walls(lambda: _painted(rng, walls, radius_m), radius_m)
    low, light = rng.uniform(15, 90), rng.uniform(45, 160)
    options = {
        "sensor": sensor,
        "supersample": 2,
        "walls": painted,
        "seed": number,
        "contrast": (low, min(250.0, low + light)),
        "shadow": rng.choice([1.0, 1.0, rng.uniform(0.35, 0.8)]),
    }
    rendered = renderer.render_board(_pose(rng, kind, renderer), **options)
    empty = renderer.render_board(BEHIND_THE_WALLS, **options)
    exposure = MountedSensor.of(sensor, mask, size)
    images = [
        cv2.imdecode(np.frombuffer(exposure.jpeg(made.image), np.uint8), cv2.IMREAD_GRAYSCALE)
        for made in (rendered, empty)
    ]
    name = (
        f"{number:03d} {kind} {size[0]}x{size[1]} {walls} {board.columns}x{board.rows} noise "
        f"{sensor.noise_sigma:.1f} blur {sensor.blur_px:.1f} step {light:.0f}"
    )
    return HardBoard(name, board, images[0].astype(np.uint8), images[1].astype(np.uint8), rendered.corners)


def _camera(rng: Random, kind: str, size: tuple[int, int]) -> tuple[OmniCamera, Mask]:
    least = min(size)
    u, v = ((side - 1) / 2 + rng.uniform(-0.015, 0.015) * least for side in size)
    mask = Mask((u, v), 0.0 if kind == "fisheye" else rng.uniform(0.06, 0.12) * least, rng.uniform(0.46, 0.49) * least)
    if kind == "fisheye":
        a0, a2 = rng.uniform(-0.42, -0.33) * least, rng.uniform(0.5, 0.65) / least
        return OcamCamera((a0, 0.0, a2), (v, u), (1.0, 0.0, 0.0), size, "direct"), mask
    xi = 1.0 if kind == "parabolic" else rng.uniform(0.7, 0.95)
    focal, stretch = rng.uniform(0.24, 0.3) * least * xi, rng.uniform(0.995, 1.005)
    bent = (rng.uniform(-0.02, 0.02), 0.0, rng.uniform(-2e-3, 2e-3), rng.uniform(-2e-3, 2e-3))
    return UnifiedCamera(xi, (-focal, focal * stretch), (u, v), size, bent), mask


def _sensor(rng: Random) -> Sensor:
    return Sensor(
        noise_sigma=rng.uniform(0.5, 7),
        blur_px=rng.uniform(0.3, 1.6),
        vignette=rng.uniform(0, 0.6),
        jpeg_quality=int(rng.integers(40, 96)),
    )


def _pose(rng: Random, kind: str, renderer: BoardRenderer) -> Array:
    """Return T_cam_board of a board entirely in view, its squares within SQUARE_PX, tilted by up to 60 degrees."""
    camera, mask, board = renderer.mounted.camera, renderer.mounted.visible, renderer.board
    down = (115.0, 175.0) if kind == "fisheye" else (35.0, 105.0)
    for _ in range(TRIES):
        azimuth, away = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(*down))
        ray = np.array([np.cos(azimuth) * np.sin(away), np.sin(azimuth) * np.sin(away), np.cos(away)])
        tilt = np.deg2rad(rng.uniform(-60, 60, 3) * (1, 1, 3))
        T = board_pose(ray, float(np.exp(rng.uniform(np.log(0.12), np.log(1.2)))), tilt, board)
        if in_view(camera, T, board, mask) and _fair(camera.project(se3.apply(T, board.points)), board):
            return T
    raise AssertionError("no board fits into the view")


def _fair(corners: Array, board: Board) -> bool:
    grid = corners.reshape(board.rows, board.columns, 2)
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=2) for axis in (0, 1)]
    usual = float(np.median(np.concatenate([side.ravel() for side in sides])))
    return SQUARE_PX[0] < usual < SQUARE_PX[1] and min(side.min() for side in sides) > LEAST_PX


def _painted(rng: Random, kind: str, radius_m: float) -> Image:
    """Return a wall's texture, pixels of 5 mm or larger."""
    side = min(1400, round(2 * radius_m * 200))
    px_per_m = side / (2 * radius_m)
    own: dict[str, Callable[[], Image]] = {
        "windows": lambda: _windows(rng, side, px_per_m),
        "chequers": lambda: _chequers(rng, side, px_per_m),
        "stripes": lambda: _stripes(rng, side, px_per_m),
        "page": lambda: textures._page(rng, (side, side)),
        "clouds": lambda: textures.PAINTERS["plaster"](rng, (side, side), px_per_m),
    }
    return own[kind]() if kind in own else textures.PAINTERS[kind](rng, (side, side), px_per_m)


def _windows(rng: Random, side: int, px_per_m: float) -> Image:
    """Return a grid of dark panes in a light frame, or of light panes in a dark frame."""
    pane, bar = (max(3, round(px_per_m * rng.uniform(*size))) for size in ((0.12, 0.35), (0.03, 0.1)))
    frame, glass = rng.permutation([rng.uniform(30, 80), rng.uniform(150, 220)])
    place = np.arange(side) % (pane + bar) < pane
    return np.where(place[:, None] & place, glass, frame).astype(np.uint8)


def _chequers(rng: Random, side: int, px_per_m: float) -> Image:
    """Return a floor of dark and light slabs, as regular as a board but without its outline."""
    slab = max(3, round(px_per_m * rng.uniform(0.15, 0.45)))
    j, i = np.indices((side, side)) // slab
    return np.where((i + j) % 2, rng.uniform(30, 90), rng.uniform(140, 220)).astype(np.uint8)


def _stripes(rng: Random, side: int, px_per_m: float) -> Image:
    """Return a wallpaper of stripes with fainter stripes across."""
    width = max(2, round(px_per_m * rng.uniform(0.04, 0.15)))
    j, i = np.indices((side, side)) // width
    return (rng.uniform(60, 110) + 90 * (i % 2) + rng.uniform(0, 25) * (j % 2)).astype(np.uint8)


# Tolerance of a corner as a fraction of its square's narrower side, or in pixels; the next edge is half a side away.
RIGHT_PART, RIGHT_PX = 0.25, 1.0
LEAST_FOUND = 0.8
REMARKS = ("Wrong counts also each board that is found where there is none.",)


def found_corners(image: Image, board: Board) -> Array | None:
    """Return the corners (N, 2) [px] that omnid finds, NaN if hidden; None without a board."""
    view = find_board(image, board)
    return None if view is None else view.pixels


def classify_detection(found: Array | None, rendered: HardBoard) -> str:
    """Return found, wrong or missed."""
    if found is None:
        return "missed"
    truth = rendered.corners.reshape(rendered.board.rows, rendered.board.columns, 2)
    sides = [np.linalg.norm(np.diff(truth, axis=axis), axis=2).min() for axis in (0, 1)]
    orders = [truth, truth[::-1], truth[:, ::-1], truth[::-1, ::-1]]
    if rendered.board.columns == rendered.board.rows:
        orders += [order.swapaxes(0, 1) for order in orders]
    off = min(float(np.nanmax(np.linalg.norm(found - order.reshape(-1, 2), axis=1))) for order in orders)
    return "found" if off < max(RIGHT_PX, RIGHT_PART * min(sides)) else "wrong"


def boards(*, seed: int = 1, first: int = 0, count: int = 50) -> int:
    """Print the outcome for every image, and the sums; 1 if a board is wrong, or fewer than four of five are found."""
    sums = Counter[str]()
    for number in range(first, first + count):
        shot = render_hard_board(seed, number)
        outcome = classify_detection(found_corners(shot.image, shot.board), shot)
        sums[outcome] += 1
        sums["wrong"] += found_corners(shot.empty, shot.board) is not None
        print(f"{shot.name}: {outcome}", flush=True)
    kinds = ("found", "wrong", "missed")
    table = ResultTable("boards_hard", "Board detection in hard renderings", columns("images", *kinds), REMARKS)
    table.add(count, *(sums[kind] for kind in kinds), seed=("boards, hard", seed))
    return int(sums["wrong"] > 0 or sums["found"] < LEAST_FOUND * count)


if __name__ == "__main__":
    run(boards)
