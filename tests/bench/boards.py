"""Board detection in hard renderings, compared with OpenCV: `python -m tests.bench.boards [--seed 1] [--count 50]`.

Each image is made of a number, with exact corners. `--near`: near, large and slanted boards in equidistant lenses whose
image circle is larger than the sensor, some with a frame that covers their edge, half in shadow, out of focus in the
corners. A board is found if all its corners are near the true ones, and wrong if one is not: a wrong board corrupts a
calibration without notice. omnid's detector is also applied to the same scenes without the board, where every detection
is wrong.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import Board
from calib.boards.board_finder import find_board
from calib.models.camera import Array, Mask, OmniCamera
from calib.models.lens import EquidistantCamera
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera
from omnid.simulation.rendering import textures
from omnid.simulation.rendering.sensor import MountedSensor, Sensor
from omnid.simulation.rendering.textures import value_noise
from tests.bench.results import Column, ResultTable
from tests.simulation.boards import SQUARE_PX as SQUARE_PX_OF_PRINT
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
# Near boards in wide-angle lenses.
NEAR_SIZE, NEAR_BOARDS = (1280, 800), (Board(8, 6, 0.03), Board(9, 6, 0.03), Board(7, 5, 0.04))
# Focal length [px]: 180 degrees are 1.0 to 1.3 widths of the image.
FOCAL_PX = (400.0, 520.0)
NEAR_DISTANCE_M, TILT_DEG, NEAR_SQUARE_PX = (0.07, 0.4), 65.0, (9.0, 160.0)
# The corners lie within the image by this margin; the squares around them need not.
MARGIN_PX = 6.0
# Squares of the print's edge that a frame covers: nothing, the light margin, a part of the outermost squares.
COVERS = (0.0, 0.9, 1.0, 1.3, 1.6)
# Blur of the sharpest and the least sharp part [px].
SHARP_PX, DEFOCUSED_PX = (0.4, 0.9), (0.5, 3.0)


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
        "clouds": lambda: textures.plaster(rng, (side, side), px_per_m),
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


def render_near_board(seed: int, number: int) -> HardBoard:
    """Render the image of that number: the boards alternate, all else is random."""
    rng = np.random.default_rng([seed, number, 7])
    board = NEAR_BOARDS[number % len(NEAR_BOARDS)]
    centre = tuple((side - 1) / 2 + rng.uniform(-8, 8) for side in NEAR_SIZE)
    focal = rng.uniform(*FOCAL_PX)
    camera = EquidistantCamera((0.0, 0.0, 0.0, 0.0), (focal, focal), (centre[0], centre[1]), NEAR_SIZE)
    renderer = BoardRenderer.of(board, camera, Mask((centre[0], centre[1]), 0.0, float(np.hypot(*NEAR_SIZE))))
    sensor = Sensor(
        noise_sigma=rng.uniform(0.5, 4),
        blur_px=rng.uniform(*SHARP_PX),
        vignette=rng.uniform(0, 0.7),
        jpeg_quality=int(rng.integers(60, 96)),
    )
    low, light = rng.uniform(15, 70), rng.uniform(60, 170)
    cover = COVERS[number % len(COVERS)]
    frame = partial(_framed, cover, low if rng.uniform() < 0.5 else low + light, np.random.default_rng([seed, number]))
    options = {
        "sensor": sensor,
        "frame": frame,
        "supersample": 2,
        "seed": number,
        "contrast": (low, low + light),
        "shadow": rng.choice([1.0, rng.uniform(0.3, 0.8)]),
    }
    T, blur = _near_pose(rng, camera, board), rng.uniform(*DEFOCUSED_PX)
    rendered, empty = (renderer.render_board(pose, **options) for pose in (T, BEHIND_THE_WALLS))
    shape = MountedSensor.of(sensor, renderer.mounted.visible, NEAR_SIZE)
    images = [
        cv2.imdecode(
            np.frombuffer(shape.jpeg(_defocused(made.image, blur, number)), np.uint8), cv2.IMREAD_GRAYSCALE
        ).astype(np.uint8)
        for made in (rendered, empty)
    ]
    name = (
        f"{number:03d} near {board.columns}x{board.rows} cover {cover:g} noise {sensor.noise_sigma:.1f} blur up to "
        f"{blur:.1f} step {light:.0f}"
    )
    return HardBoard(name, board, images[0], images[1], rendered.corners)


def _framed(cover: float, grey: float, rng: Random, texture: Array) -> Array:
    """Return the print with a frame that covers its edge by some squares, and a cluttered surface."""
    width = round(cover * SQUARE_PX_OF_PRINT)
    framed = np.clip(grey + 25 * value_noise(rng, texture.shape[::-1], 40.0), 0, 255).astype(float)
    if not width:
        return texture
    framed[width:-width, width:-width] = texture[width:-width, width:-width]
    return framed


def _defocused(image: NDArray[np.uint8], blur_px: float, number: int) -> NDArray[np.uint8]:
    """Return the image, blurred towards one of its ends."""
    width = image.shape[1]
    part = np.linspace(0, 1, width)[None] if number % 2 else np.linspace(1, 0, width)[None]
    blurred = cv2.GaussianBlur(image, (0, 0), blur_px).astype(float)
    return np.rint(image * (1 - part) + blurred * part).astype(np.uint8)


def _near_pose(rng: Random, camera: EquidistantCamera, board: Board) -> Array:
    """Return T_cam_board with all corners in the image, the squares' median side within NEAR_SQUARE_PX."""
    for _ in range(TRIES):
        azimuth, away = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(0, 75))
        ray = np.array([np.cos(azimuth) * np.sin(away), np.sin(azimuth) * np.sin(away), np.cos(away)])
        tilt = np.deg2rad(rng.uniform(-TILT_DEG, TILT_DEG, 3) * (1, 1, 2))
        T = board_pose(ray, float(np.exp(rng.uniform(*np.log(NEAR_DISTANCE_M)))), tilt, board)
        if _is_in_image(camera.project(se3.apply(T, board.points)), board) and _faces(T, board):
            return T
    raise AssertionError("no board fits into the image")


def _faces(T: Array, board: Board) -> bool:
    """True if every corner is seen from the front, by 8 degrees at least."""
    points = se3.apply(T, board.points)
    return bool((points @ T[:3, 2] > np.sin(np.deg2rad(8)) * np.linalg.norm(points, axis=1)).all())


def _is_in_image(corners: Array, board: Board) -> bool:
    inside = (corners > MARGIN_PX).all() and (corners < np.array(NEAR_SIZE) - 1 - MARGIN_PX).all()
    grid = corners.reshape(board.rows, board.columns, 2)
    sides = np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (0, 1)])
    return bool(
        inside and NEAR_SQUARE_PX[0] < np.median(sides) < NEAR_SQUARE_PX[1] and sides.min() > NEAR_SQUARE_PX[0] / 2
    )


# Tolerance of a corner in parts of its square's narrower side, or in pixels; the next edge is half a side away.
RIGHT_PART, RIGHT_PX = 0.25, 1.0
# Returns corners (N, 2) [px], NaN if hidden.
Detect = Callable[[Image, Board], Array | None]


def _ours(image: Image, board: Board) -> Array | None:
    view = find_board(image, board).view
    return None if view is None else view.pixels


def _plain(image: Image, board: Board) -> Array | None:
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    return _corners(*cv2.findChessboardCorners(image, (board.columns, board.rows), flags=flags))


def _sector(image: Image, board: Board) -> Array | None:
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    return _corners(*cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=flags))


def _corners(found: bool, corners: Array | None) -> Array | None:
    return np.asarray(corners, float).reshape(-1, 2) if found and corners is not None else None


REMARKS = ("Wrong counts, for omnid only, also each board that is found where there is none.",)
DETECTORS: dict[str, Detect] = {"omnid": _ours, "findChessboardCorners": _plain, "findChessboardCornersSB": _sector}


def classify_detection(found: Array | None, rendered: HardBoard) -> str:
    """Return found, wrong or missed."""
    if found is None:
        return "missed"
    truth = rendered.corners.reshape(rendered.board.rows, rendered.board.columns, 2)
    sides = [np.linalg.norm(np.diff(truth, axis=axis), axis=2).min() for axis in (0, 1)]
    orders = corner_orders(truth, rendered.board)
    off = min(float(np.nanmax(np.linalg.norm(found - order, axis=1))) for order in orders)
    return "found" if off < max(RIGHT_PX, RIGHT_PART * min(sides)) else "wrong"


def corner_orders(truth: Array, board: Board) -> list[Array]:
    """Return the truth (N, 2) in every order that a detector may return, flipped or rotated."""
    orders = [truth, truth[::-1], truth[:, ::-1], truth[::-1, ::-1]]
    if board.columns == board.rows:
        orders += [order.swapaxes(0, 1) for order in orders]
    return [order.reshape(-1, 2) for order in orders]


def count(shots: Sequence[HardBoard], detect: Detect, *, empty: bool = True) -> Counter[str]:
    """Count the boards that a detector found, missed and got wrong."""
    counts = Counter(classify_detection(detect(rendered.image, rendered.board), rendered) for rendered in shots)
    counts["wrong"] += sum(detect(rendered.empty, rendered.board) is not None for rendered in shots) if empty else 0
    return counts


def main(arguments: list[str]) -> int:
    """Print the outcome of each detector for every image, and the sums; 1 if a board is wrong or too few are found."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.boards", description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first image")
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--near", action="store_true", help="boards near a wide-angle lens")
    args = parser.parse_args(arguments)
    render = render_near_board if args.near else render_hard_board
    sums = {name: Counter[str]() for name in DETECTORS}
    for number in range(args.first, args.first + args.count):
        rendered = render(args.seed, number)
        outcomes_of = {name: count([rendered], detect, empty=name == "omnid") for name, detect in DETECTORS.items()}
        for name, found in outcomes_of.items():
            sums[name] += found
        outcomes = ", ".join(f"{name} {_outcomes(found)}" for name, found in outcomes_of.items())
        print(f"{rendered.name}: {outcomes}", flush=True)
    kinds, family = ("found", "wrong", "missed"), f"boards, {'near' if args.near else 'hard'}"
    table = ResultTable(
        family.replace(", ", "_"),
        "calibration",
        f"Board detection, {'near' if args.near else 'hard'}",
        (Column("detector"), Column("images"), *map(Column, kinds)),
        REMARKS,
    )
    for name, all_of in sums.items():
        table.add(name, args.count, *(all_of[kind] for kind in kinds), seed=(family, args.seed))
    return 0 if meets_requirement(sums, args.count) else 1


def _outcomes(found: Counter[str]) -> str:
    return "/".join(kind for kind in ("found", "missed", "wrong") if found[kind])


def meets_requirement(sums: dict[str, Counter[str]], images: int) -> bool:
    """True if no board is wrong, and omnid finds as many as OpenCV's best detector and half of what that misses."""
    best = max(sums[name]["found"] for name in DETECTORS if name != "omnid")
    return sums["omnid"]["wrong"] == 0 and sums["omnid"]["found"] >= best + (images - best) / 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
