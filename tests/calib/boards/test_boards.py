"""Boards in rendered mirror images: noise, low contrast, accuracy; AprilTag grids; images without a board."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib.boards.aprilgrid import find_april_grid
from calib.boards.board import AprilGrid, Board
from calib.boards.checkerboard import find_board
from calib.errors import CalibError
from calib.models.camera import Array, Mask
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera
from omnid.simulation.rendering.ray_caster import Sensor
from tests.simulation.boards import (
    SQUARE_PX,
    BoardRenderer,
    board_poses_around_camera,
    board_texture,
    frame_board,
    print_of,
    render_april_grid,
)
from tests.simulation.disturbances import FlawedSensor

BOARD = Board(6, 5, 0.03)
CAMERA = UnifiedCamera(0.9, (-150.0, 151.0), (241.3, 237.8), (480, 480))
MASK = Mask((241.3, 237.8), 40.0, 232.0)
RENDERER = BoardRenderer.of(BOARD, CAMERA, MASK)


def poses(count: int, seed: int = 0, distance_m: tuple[float, float] = (0.15, 0.28)) -> list[Array]:
    return board_poses_around_camera(CAMERA, BOARD, MASK, count, seed=seed, distance_m=distance_m)


def errors_px(found: Array, truth: Array) -> Array:
    """Return the distances to the truth in the best order of corners: a flat board does not determine it."""
    grid = truth.reshape(BOARD.rows, BOARD.columns, 2)
    ways = [way.reshape(-1, 2) for way in (grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1])]
    distances = [np.linalg.norm(found - way, axis=1) for way in ways]
    return min(distances, key=lambda way: float(np.nanmax(way)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "contrast", "limit_px"),
    [
        (Sensor(), (25.0, 225.0), 0.08),
        (Sensor(noise_sigma=6.0), (25.0, 225.0), 0.5),
        (FlawedSensor(blur_px=1.4, vignette=0.6), (70.0, 140.0), 0.5),
    ],
)
def test_boards_are_found_on_all_sides(sensor: Sensor, contrast: tuple[float, float], limit_px: float) -> None:
    for seed, T in enumerate(poses(3)):
        rendered = RENDERER.render_board(T, seed=seed, sensor=sensor, contrast=contrast)
        view = find_board(rendered.image, BOARD)
        assert view is not None and np.isfinite(view).mean() > 0.7, seed
        off = errors_px(view, rendered.corners)
        assert np.nanmedian(off) < limit_px / 2 and np.nanpercentile(off, 90) < limit_px, seed


def test_a_board_is_found_through_a_fisheye_lens() -> None:
    camera = OcamCamera((-180.0, 0.0, 1.2e-3), (238.0, 241.0), (1.0, 0.0, 0.0), (480, 480), "direct")
    mask = Mask(camera.center, 0.0, 232.0)
    T = board_poses_around_camera(camera, BOARD, mask, 1, distance_m=(0.2, 0.3), elevation_deg=(120, 150))[0]
    rendered = BoardRenderer.of(BOARD, camera, mask).render_board(T)
    view = find_board(rendered.image, BOARD)
    assert view is not None
    assert np.nanmax(errors_px(view, rendered.corners)) < 0.2


def test_corner_order_is_clockwise_and_starts_at_a_dark_square() -> None:
    for seed, T in enumerate(poses(3, seed=4)):
        rendered = RENDERER.render_board(T, seed=seed)
        view = find_board(rendered.image, BOARD)
        assert view is not None
        grid = view.reshape(BOARD.rows, BOARD.columns, 2)
        along, down = np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1]
        assert (along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0] > 0).all()
        first, second = (grid[:2, i : i + 2].mean(axis=(0, 1)).round().astype(int) for i in (0, 1))
        assert rendered.image[first[1], first[0]] < rendered.image[second[1], second[0]]
        flipped = find_board(np.ascontiguousarray(rendered.image[:, ::-1]), BOARD)
        assert flipped is not None


def test_a_board_of_another_size_is_not_found() -> None:
    rendered = RENDERER.render_board(poses(1, seed=2)[0])
    for asked in ((5, 4), (7, 5)):
        assert find_board(rendered.image, Board(*asked, 0.03)) is None, asked


@pytest.mark.slow
def test_images_without_a_board_give_none() -> None:
    rng = np.random.default_rng(3)
    noise = rng.integers(0, 255, (300, 300)).astype(np.uint8)
    stripes = np.where(np.arange(300) // 10 % 2, 40, 200).astype(np.uint8)
    dots = np.where(np.hypot(*(np.indices((300, 300)) % 30 - 15)) < 9, 30, 220).astype(np.uint8)
    brickwork = np.where((np.indices((300, 300))[1] + 10 * (np.indices((300, 300))[0] // 12 % 2)) % 20 < 2, 30, 200)
    images: list[NDArray[np.uint8]] = [
        noise,
        np.tile(stripes, (300, 1)),
        dots,
        brickwork.astype(np.uint8),
        np.zeros((50, 40), np.uint8),
    ]
    for number, image in enumerate(images):
        assert find_board(image, Board(4, 3, 0.03)) is None, number


@pytest.mark.slow
def test_the_board_is_found_in_all_ten_real_images(shared_data: Path) -> None:
    for number in range(10):
        image = cv2.imread(str(shared_data / "vmr_board" / f"VMRImage{number}.jpg"), cv2.IMREAD_GRAYSCALE)
        view = find_board(image.astype(np.uint8), Board(6, 7, 0.03))
        assert view is not None and np.isfinite(view).all(), number


def test_a_board_whose_outer_squares_the_image_cuts_off_is_found() -> None:
    sheet = cv2.resize(board_texture(BOARD), None, fx=3, fy=3, interpolation=cv2.INTER_AREA)
    cut = round(3 * SQUARE_PX * 1.65)
    image = np.asarray(cv2.GaussianBlur(sheet[cut:-cut, cut:-cut], (0, 0), 1.0), np.uint8)
    view = find_board(image, BOARD)
    assert view is not None and np.isfinite(view).mean() > 0.9
    x, y = np.meshgrid(np.arange(6), np.arange(5))
    truth = np.asarray(3 * SQUARE_PX * (np.column_stack([x.ravel(), y.ravel()]) + 2.0) - 0.5 - cut, float)
    assert np.nanmax(errors_px(view, truth)) < 0.3


# AprilTag grids


GRID_MASK = Mask((241.3, 237.8), 40.0, 232.0)
MOUNTED = MountedCamera(UnifiedCamera(0.9, (-150.0, 151.0), GRID_MASK.center, (480, 480)), np.eye(4), GRID_MASK)
GRID = AprilGrid(4, 3, 0.06, 0.3)


@pytest.mark.parametrize(("hidden", "least", "most"), [(0.0, 0.7, 1.0), (0.5, 0.25, 0.55)])
def test_the_visible_corners_are_found_in_a_mirror(hidden: float, least: float, most: float) -> None:
    T = board_poses_around_camera(MOUNTED.camera, frame_board(GRID), GRID_MASK, 1, seed=3, distance_m=(0.25, 0.3))[0]
    made = render_april_grid(MOUNTED, GRID, T, seed=1, sensor=Sensor(noise_sigma=2.0), hidden=hidden)
    view = find_april_grid(made.image, GRID)
    assert view is not None and least <= np.isfinite(view[:, 0]).mean() <= most
    off = np.linalg.norm(view - made.corners, axis=1)
    assert np.nanmedian(off) < 0.05 and np.nanpercentile(off, 90) < 0.3


def test_tags_elsewhere_than_on_the_grid_are_no_grid() -> None:
    image = np.ascontiguousarray(print_of(AprilGrid(3, 4, 0.06, 0.3))[:, ::-1])
    assert find_april_grid(image, AprilGrid(3, 4, 0.06, 0.3)) is not None
    assert find_april_grid(image, AprilGrid(9, 2, 0.06, 0.9)) is None
    assert find_april_grid(np.full((100, 100), 90, np.uint8), GRID) is None


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ((6, 6, float("nan"), 0.3), "tags of a length above 0"),
        ((6, 6, 0.08, 24.0), "like Kalibr's tagSpacing, found 24"),
        ((30, 30, 0.08, 0.3), "expected 1 to 587 tags, .* found 30x30"),
    ],
)
def test_impossible_grids_are_refused(sizes: tuple[int, int, float, float], words: str) -> None:
    with pytest.raises(CalibError, match=words):
        AprilGrid(*sizes)
