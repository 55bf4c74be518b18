"""Prints of boards with markers, for the renderer: ChArUco boards by OpenCV, AprilTag grids as Kalibr draws them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import Board
from calib.boards.marker_board import AprilGrid, CharucoBoard, MarkerBoard, predefined
from calib.models.camera import Array
from calib.rig import MountedCamera
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.sensor import MountedSensor, Sensor
from omnid.simulation.rendering.surfaces import Rectangle, Scene
from tests.simulation.boards import BoardImage, clutter

# Pixels of a charuco's square and of a tag's bit in the print; light margin in squares or tags.
SQUARE_PX, BIT_PX, MARGIN = 56, 8, 0.5
# Tags of the family 36h11 are drawn row by row, the most significant bit at the upper left; 1 is light. These are the
# first codes of its definition (AprilTag, Olson 2011), which check the orientation and numbers of the others.
TAG_CODES = (0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98)
BITS, BORDER_BITS = 6, 2


def frame_board(board: MarkerBoard) -> Board:
    """Return a checkerboard that covers the corners of a board with markers, to choose poses for both."""
    if isinstance(board, CharucoBoard):
        return Board(board.columns, board.rows, board.square_m)
    width = float(np.ptp(board.points[:, 0]))
    return Board(6, max(3, round(1 + 5 * float(np.ptp(board.points[:, 1])) / width)), width / 5)


def render_marker_board(
    mounted: MountedCamera,
    board: MarkerBoard,
    T_rig_frame: Array,
    *,
    seed: int = 0,
    sensor: Sensor | None = None,
    hidden: float = 0.0,
) -> BoardImage:
    """Render a board at the pose of its frame_board, with a grey card in front of a part of it (from the left).

    The corners of the result are all of the board's points, hidden or not; T_cam_board is that of the board.
    """
    rng, print_ = np.random.default_rng(seed), _print(board).astype(float) * (200 / 255) + 25
    print_[:, : round(hidden * print_.shape[1])] = 120
    height = float(np.ptp(board.points[:, 1]))
    # Kalibr's y points up on the print, z to the viewer.
    T_frame_board = (
        np.eye(4) if isinstance(board, CharucoBoard) else se3.transform(np.diag([1.0, -1, -1]), [0.0, height, 0.0])
    )
    edge = MARGIN * board.square_m + (board.square_m if isinstance(board, CharucoBoard) else 0.0)
    width = float(np.ptp(board.points[:, 0]))
    ends = np.array([[-edge, -edge, 0], [width + edge, -edge, 0], [-edge, height + edge, 0]])
    origin, right, below = se3.apply(T_rig_frame, ends)
    sheet = Rectangle(origin, right - origin, below - origin, print_.astype(np.uint8), "board")
    scene = Scene((sheet, *clutter(rng)))
    ideal = render_grey(scene, mounted, np.eye(4), 2)
    exposure = MountedSensor.of(sensor or Sensor(), mounted.visible, mounted.camera.size)
    T_cam_board = mounted.T_cam_rig @ T_rig_frame @ T_frame_board
    return BoardImage(
        exposure.expose(ideal, rng), mounted.camera.project(se3.apply(T_cam_board, board.points)), T_cam_board
    )


def print_of(board: MarkerBoard) -> tuple[NDArray[np.uint8], Array]:
    """Return the print (H, W) as a camera right in front of it would see it, and the pixels (N, 2) of its corners."""
    sheet, points = _print(board), board.points[:, :2] / board.square_m
    if isinstance(board, CharucoBoard):
        return sheet, (points + 1 + MARGIN) * SQUARE_PX - 0.5
    tag_px = (BITS + 2 * BORDER_BITS) * BIT_PX
    return sheet, np.column_stack([points[:, 0] + MARGIN, np.ptp(points[:, 1]) - points[:, 1] + MARGIN]) * tag_px - 0.5


def _print(board: MarkerBoard) -> NDArray[np.uint8]:
    """Return the print (H, W) with its margin."""
    if isinstance(board, CharucoBoard):
        squares = (board.columns + 1, board.rows + 1)
        charuco = cv2.aruco.CharucoBoard(squares, board.square_m, board.marker_m, predefined(board.dictionary))
        charuco.setLegacyPattern(board.legacy)
        size = (squares[0] * SQUARE_PX, squares[1] * SQUARE_PX)
        return np.pad(charuco.generateImage(size), round(MARGIN * SQUARE_PX), constant_values=255).astype(np.uint8)
    return _april_print(board)


def _april_print(board: AprilGrid) -> NDArray[np.uint8]:
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
    marker = cv2.aruco.generateImageMarker(predefined("APRILTAG_36h11"), number, BITS + 2, borderBits=1)[1:-1, 1:-1]
    # OpenCV draws the family upside down.
    bits = np.rot90(marker, 2)
    if number < len(TAG_CODES):
        code = [TAG_CODES[number] >> k & 1 for k in range(BITS**2 - 1, -1, -1)]
        bits = 255 * np.array(code).reshape(BITS, BITS)
    return np.pad(bits, BORDER_BITS).astype(np.uint8)
