"""Rendered boards: checkerboards and AprilTag grids in mirror images, with exact corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import AS_DRAWN, AprilGrid, Board, PrintShape
from calib.models.camera import Array, Mask, OmniCamera
from calib.rig import MountedCamera, Rig
from omnid.simulation.rendering.ray_caster import Sensor
from omnid.simulation.rendering.surfaces import Rectangle, Scene, value_noise
from tests.simulation.disturbances import MountedSensor
from tests.simulation.rigs import render_real

# Side of a square in the board's texture.
SQUARE_PX = 24
# Width of the light margin around the squares.
MARGIN_SQUARES = 1.0


@dataclass(frozen=True)
class BoardImage:
    """An image (H, W) uint8 of a board with its ground truth: corners (N, 2) [px] and T_cam_board (4, 4)."""

    image: NDArray[np.uint8]
    corners: Array
    T_cam_board: Array


def board_texture(board: Board, dark: float = 25.0, light: float = 225.0) -> NDArray[np.uint8]:
    """Return the print: (columns + 1) x (rows + 1) squares with a light margin; the first square is dark."""
    j, i = np.indices((board.rows + 1, board.columns + 1))
    squares = np.where((i + j) % 2 == 0, dark, light)
    margin = round(MARGIN_SQUARES * SQUARE_PX)
    large = np.kron(squares, np.ones((SQUARE_PX, SQUARE_PX)))
    return np.pad(large, margin, constant_values=light).astype(np.uint8)


def board_rectangle(board: Board, T_rig_board: Array, texture: NDArray[np.uint8]) -> Rectangle:
    """Return the print as a rectangle in the rig's frame; the board's origin is its first inner corner."""
    edge = (1 + MARGIN_SQUARES) * board.square_m
    width, height = ((side + 1 + 2 * MARGIN_SQUARES) * board.square_m for side in (board.columns, board.rows))
    origin, right, below = se3.apply(
        T_rig_board, np.array([[-edge, -edge, 0], [width - edge, -edge, 0], [-edge, height - edge, 0]])
    )
    return Rectangle(origin, right - origin, below - origin, texture, "board")


def print_rectangles(
    board: Board, shape: PrintShape, T_rig_board: Array, texture: NDArray[np.uint8]
) -> list[Rectangle]:
    """Return the print as rectangles in the rig's frame; one about each corner and its margin if it is not flat.

    A surface that is a sum of functions of x and y is met exactly by parallelograms; a twist leaves gaps of some
    hundredths of a millimetre, between which the shape is flat.
    """
    if shape == AS_DRAWN:
        return [board_rectangle(board, T_rig_board, texture)]
    # Borders of the parts in squares from the first corner: the middles of the squares, where the texture is even.
    x, y = (
        np.array([-1 - MARGIN_SQUARES, *np.arange(side + 1) - 0.5, side + MARGIN_SQUARES])
        for side in (board.columns, board.rows)
    )
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) * board.square_m
    corners = se3.apply(T_rig_board, shape.points_of(board.points, np.column_stack([grid, np.zeros(len(grid))])))
    corners = corners.reshape(len(y), len(x), 3)
    column, row = (np.round((borders + 1 + MARGIN_SQUARES) * SQUARE_PX).astype(int) for borders in (x, y))
    return [
        Rectangle(
            corners[j, i],
            corners[j, i + 1] - corners[j, i],
            corners[j + 1, i] - corners[j, i],
            np.ascontiguousarray(texture[row[j] : row[j + 1], column[i] : column[i + 1]]),
            "board",
        )
        for j, i in np.ndindex(len(y) - 1, len(x) - 1)
    ]


def clutter(rng: np.random.Generator, radius_m: float = 3.0) -> list[Rectangle]:
    """Return six square noisy walls around the camera."""
    walls = []
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        side = np.roll(axis, 1) * 2 * radius_m
        below = np.roll(axis, 2) * 2 * radius_m
        noise = np.clip(120 + 45 * value_noise(rng, (400, 400), 60.0), 0, 255).astype(np.uint8)
        walls.append(Rectangle(axis * radius_m - side / 2 - below / 2, side, below, noise))
    return walls


def board_pose(ray: Array, distance_m: float, tilt_rad: Array, board: Board) -> Array:
    """Return T_cam_board (4, 4) of a board with its middle along a ray, facing the camera up to a tilt (3,)."""
    z = ray / np.linalg.norm(ray)
    x = np.cross([0.3, 0.2, 1.0], z)
    x /= np.linalg.norm(x)
    R = np.column_stack([x, np.cross(z, x), z]) @ se3.rotation_exp(tilt_rad)
    middle = np.array([(board.columns - 1) / 2, (board.rows - 1) / 2, 0]) * board.square_m
    return se3.transform(R, z * distance_m - R @ middle)


@dataclass(frozen=True)
class BoardRenderer:
    """Renders images of a board by a mounted camera, whose rays are computed once for all images."""

    board: Board
    mounted: MountedCamera
    shape: PrintShape = AS_DRAWN

    @staticmethod
    def of(board: Board, camera: OmniCamera, mask: Mask) -> BoardRenderer:
        """Return the renderer of a camera at the origin."""
        return BoardRenderer(board, MountedCamera(camera, np.eye(4), mask))

    def render_board(
        self,
        T_rig_board: Array,
        *,
        seed: int = 0,
        sensor: Sensor | None = None,
        supersample: int = 2,
        contrast: tuple[float, float] = (25.0, 225.0),
        shadow: float = 1.0,
    ) -> BoardImage:
        """Render the board among noisy walls; shadow: brightness factor of a part of the board."""
        rng = np.random.default_rng(seed)
        texture = board_texture(self.board, *contrast).astype(float)
        texture[:, : round(texture.shape[1] * rng.uniform(0.3, 0.7))] *= shadow
        around = clutter(rng)
        faces = print_rectangles(self.board, self.shape, T_rig_board, texture.astype(np.uint8))
        points = self.shape.points(self.board.points)
        scene, T_cam_board = Scene((*faces, *around)), self.mounted.T_cam_rig @ T_rig_board
        return exposed(scene, self.mounted, points, T_cam_board, sensor or Sensor(), rng, supersample)


def exposed(
    scene: Scene,
    mounted: MountedCamera,
    points: Array,
    T_cam_board: Array,
    sensor: Sensor,
    rng: np.random.Generator,
    supersample: int = 2,
) -> BoardImage:
    """Return the image of a scene with a board that has its points (N, 3) [m] at a pose."""
    ideal = render_real(scene, mounted, np.eye(4), supersample)
    image = MountedSensor(sensor, mounted.visible, mounted.camera.size).expose(ideal, rng)
    return BoardImage(image, mounted.camera.project(se3.apply(T_cam_board, points)), T_cam_board)


def in_view(camera: OmniCamera, T_cam_board: Array, board: Board, mask: Mask) -> bool:
    """True if the print without its margin lies inside the mask and faces the camera."""
    x, y = (np.linspace(-1.3, side + 0.3, 12) for side in (board.columns, board.rows))
    outline = np.stack([*np.meshgrid(x, y), np.zeros((12, 12))], axis=-1).reshape(-1, 3) * board.square_m
    pixels = camera.project(se3.apply(T_cam_board, outline))
    return bool(np.isfinite(pixels).all() and mask.contains(pixels, 2.0).all())


def board_poses_around_camera(
    camera: OmniCamera,
    board: Board,
    mask: Mask,
    count: int,
    *,
    seed: int = 0,
    distance_m: tuple[float, float] = (0.2, 0.5),
    tilt_deg: float = 30.0,
    elevation_deg: Sequence[float] = (35.0, 100.0),
) -> list[Array]:
    """Return poses T_cam_board on all sides of a camera, entirely in view; elevation from the ray of the centre."""
    rng, poses = np.random.default_rng(seed), list[Array]()
    for _ in range(200 * count):
        azimuth = 2 * np.pi * (len(poses) / count + 0.1 * rng.uniform())
        down = np.deg2rad(rng.uniform(*elevation_deg))
        ray = np.array([np.cos(azimuth) * np.sin(down), np.sin(azimuth) * np.sin(down), np.cos(down)])
        tilt = np.deg2rad(tilt_deg) * rng.uniform(-1, 1, 3) * (1, 1, 6)
        T = board_pose(ray, rng.uniform(*distance_m), tilt, board)
        if in_view(camera, T, board, mask):
            poses.append(T)
        if len(poses) == count:
            return poses
    raise AssertionError(f"only {len(poses)} of {count} boards fit into the view")


def board_poses_around_rig(
    rig: Rig,
    board: Board,
    count: int,
    *,
    seed: int = 0,
    distance_m: tuple[float, float] = (0.25, 0.5),
    elevation_deg: Sequence[float] = (50.0, 110.0),
) -> list[Array]:
    """Return poses T_rig_board on all sides of a rig whose frame is its lower camera's, entirely in view of both."""
    poses: list[Array] = []
    for turn in range(20 * count):
        tried = board_poses_around_camera(
            rig.lower.camera,
            board,
            rig.lower.visible,
            1,
            seed=100 * seed + turn,
            distance_m=distance_m,
            elevation_deg=elevation_deg,
        )[0]
        T = _about_axis(2 * np.pi * len(poses) / count) @ tried
        if all(
            in_view(m.camera, m.T_cam_rig @ se3.inverse(rig.lower.T_cam_rig) @ T, board, m.visible)
            for m in (rig.lower, rig.upper)
        ):
            poses.append(se3.inverse(rig.lower.T_cam_rig) @ T)
        if len(poses) == count:
            return poses
    raise AssertionError(f"only {len(poses)} of {count} boards fit into both views")


def _about_axis(angle_rad: float) -> Array:
    return se3.transform(se3.rotation_exp([0.0, 0.0, angle_rad]), np.zeros(3))


# Pixels of a tag's bit in the print; light margin in tags.
BIT_PX, MARGIN = 8, 0.5
# Tags of the family 36h11 are drawn row by row, the most significant bit at the upper left; 1 is light. These are the
# first codes of its definition (AprilTag, Olson 2011), which check the orientation and numbers of the others.
TAG_CODES = (0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98)
BITS, BORDER_BITS = 6, 2


def frame_board(board: AprilGrid) -> Board:
    """Return a checkerboard that covers the corners of a grid, to choose poses for both."""
    width = float(np.ptp(board.points[:, 0]))
    return Board(6, max(3, round(1 + 5 * float(np.ptp(board.points[:, 1])) / width)), width / 5)


def render_april_grid(
    mounted: MountedCamera,
    board: AprilGrid,
    T_rig_frame: Array,
    *,
    seed: int = 0,
    sensor: Sensor | None = None,
    hidden: float = 0.0,
) -> BoardImage:
    """Render a grid at the pose of its frame_board, with a grey card in front of a part of it (from the left).

    The corners of the result are all of the grid's points, hidden or not; T_cam_board is that of the grid.
    """
    rng, sheet = np.random.default_rng(seed), print_of(board).astype(float) * (200 / 255) + 25
    sheet[:, : round(hidden * sheet.shape[1])] = 120
    width, height = np.ptp(board.points[:, :2], axis=0)
    # Kalibr's y points up on the print, z to the viewer.
    T_frame_board = se3.transform(np.diag([1.0, -1, -1]), [0.0, height, 0.0])
    edge = MARGIN * board.tag_m
    ends = np.array([[-edge, -edge, 0], [width + edge, -edge, 0], [-edge, height + edge, 0]])
    origin, right, below = se3.apply(T_rig_frame, ends)
    rectangle = Rectangle(origin, right - origin, below - origin, sheet.astype(np.uint8), "board")
    scene, T_cam_board = Scene((rectangle, *clutter(rng))), mounted.T_cam_rig @ T_rig_frame @ T_frame_board
    return exposed(scene, mounted, board.points, T_cam_board, sensor or Sensor(), rng)


def print_of(board: AprilGrid) -> NDArray[np.uint8]:
    """Return the print (H, W) with its margin, as a camera right in front of it would see it."""
    tag_px = (BITS + 2 * BORDER_BITS) * BIT_PX
    gap, margin = round(board.spacing * tag_px), round(MARGIN * tag_px)
    height, width = (side * tag_px + (side - 1) * gap + 2 * margin for side in (board.rows, board.columns))
    sheet = np.full((height, width), 255, np.uint8)
    for number in range(board.columns * board.rows):
        row, column = divmod(number, board.columns)
        left, bottom = margin + column * (tag_px + gap), height - margin - row * (tag_px + gap)
        for x in (left - gap, left + tag_px):
            for y in (bottom, bottom - tag_px - gap):
                sheet[y : y + gap, x : x + gap] = 0
        sheet[bottom - tag_px : bottom, left : left + tag_px] = np.kron(_tag(number), np.ones((BIT_PX, BIT_PX)))
    return sheet


def _tag(number: int) -> NDArray[np.uint8]:
    """Return a tag (10, 10) with its border, 0 or 255."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    marker = cv2.aruco.generateImageMarker(dictionary, number, BITS + 2, borderBits=1)[1:-1, 1:-1]
    # OpenCV draws the family upside down.
    bits = np.rot90(marker, 2)
    if number < len(TAG_CODES):
        code = [TAG_CODES[number] >> k & 1 for k in range(BITS**2 - 1, -1, -1)]
        bits = 255 * np.array(code).reshape(BITS, BITS)
    return np.pad(bits, BORDER_BITS).astype(np.uint8)
