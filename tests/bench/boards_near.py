"""Rendered images of near, large and slanted boards in wide-angle lenses, each from one number, with exact corners.

The lens is equidistant and its image circle is larger than the sensor; the outermost squares may lie outside the image,
half of the board may be in shadow, and the corners of the image are out of focus.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import Board
from calib.models.camera import Array, Mask
from omnid.simulation.rendering.sensor import MountedSensor, Sensor
from omnid.simulation.rendering.textures import value_noise
from tests.bench.boards_rendered import BEHIND_THE_WALLS, HardBoard
from tests.simulation.boards import SQUARE_PX as SQUARE_PX_OF_PRINT
from tests.simulation.boards import BoardRenderer, board_pose

Random = np.random.Generator
SIZE, BOARDS = (1280, 800), (Board(8, 6, 0.03), Board(9, 6, 0.03), Board(7, 5, 0.04))
# Focal length [px]: 180 degrees are 1.0 to 1.3 widths of the image.
FOCAL_PX = (400.0, 520.0)
DISTANCE_M, TILT_DEG, SQUARE_PX = (0.07, 0.4), 65.0, (9.0, 160.0)
# The corners lie within the image by this margin; the squares around them need not.
MARGIN_PX, TRIES = 6.0, 4000
# Squares of the print's edge that a frame covers: nothing, the light margin, a part of the outermost squares.
COVERS = (0.0, 0.9, 1.0, 1.3, 1.6)
# Blur of the sharpest and the least sharp part [px].
SHARP_PX, DEFOCUSED_PX = (0.4, 0.9), (0.5, 3.0)


@dataclass(frozen=True, slots=True)
class EquidistantCamera:
    """A lens whose image radius is focal_px times the angle from its axis z; x right, y down."""

    focal_px: float
    center: tuple[float, float]
    size: tuple[int, int]

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3)."""
        across = np.hypot(points[:, 0], points[:, 1])
        scale = self.focal_px * np.arctan2(across, points[:, 2]) / np.maximum(across, 1e-12)
        return np.asarray(points[:, :2] * scale[:, None] + self.center)

    def lift(self, pixels: Array) -> Array:
        """Return unit rays (N, 3) of pixels (N, 2)."""
        offset = np.asarray(pixels, float) - self.center
        radius = np.linalg.norm(offset, axis=1)
        angle = np.where(radius < np.pi * self.focal_px, radius / self.focal_px, np.nan)
        return np.column_stack([offset * (np.sin(angle) / np.maximum(radius, 1e-12))[:, None], np.cos(angle)])


def render_near_board(seed: int, number: int) -> HardBoard:
    """Render the image of that number: the boards alternate, all else is random."""
    rng = np.random.default_rng([seed, number, 7])
    board = BOARDS[number % len(BOARDS)]
    centre = tuple((side - 1) / 2 + rng.uniform(-8, 8) for side in SIZE)
    camera = EquidistantCamera(rng.uniform(*FOCAL_PX), (centre[0], centre[1]), SIZE)
    renderer = BoardRenderer.of(board, camera, Mask((centre[0], centre[1]), 0.0, float(np.hypot(*SIZE))))
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
    shape = MountedSensor.of(sensor, renderer.mounted.visible, SIZE)
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
    """Return T_cam_board with all corners in the image, the squares' median side within SQUARE_PX."""
    for _ in range(TRIES):
        azimuth, away = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(0, 75))
        ray = np.array([np.cos(azimuth) * np.sin(away), np.sin(azimuth) * np.sin(away), np.cos(away)])
        tilt = np.deg2rad(rng.uniform(-TILT_DEG, TILT_DEG, 3) * (1, 1, 2))
        T = board_pose(ray, float(np.exp(rng.uniform(*np.log(DISTANCE_M)))), tilt, board)
        if _is_in_image(camera.project(se3.apply(T, board.points)), board) and _faces(T, board):
            return T
    raise AssertionError("no board fits into the image")


def _faces(T: Array, board: Board) -> bool:
    """True if every corner is seen from the front, by 8 degrees at least."""
    points = se3.apply(T, board.points)
    return bool((points @ T[:3, 2] > np.sin(np.deg2rad(8)) * np.linalg.norm(points, axis=1)).all())


def _is_in_image(corners: Array, board: Board) -> bool:
    inside = (corners > MARGIN_PX).all() and (corners < np.array(SIZE) - 1 - MARGIN_PX).all()
    grid = corners.reshape(board.rows, board.columns, 2)
    sides = np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (0, 1)])
    return bool(inside and SQUARE_PX[0] < np.median(sides) < SQUARE_PX[1] and sides.min() > SQUARE_PX[0] / 2)
