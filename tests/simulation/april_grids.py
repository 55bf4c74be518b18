"""Prints of AprilTag grids as Kalibr draws them, for the renderer."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.aprilgrid import AprilGrid
from calib.boards.board import Board
from calib.models.camera import Array
from calib.rig import MountedCamera
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.sensor import MountedSensor, Sensor
from omnid.simulation.rendering.surfaces import Rectangle, Scene
from tests.simulation.boards import BoardImage, clutter

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
    ideal = render_grey(Scene((rectangle, *clutter(rng))), mounted, np.eye(4), 2)
    exposure = MountedSensor.of(sensor or Sensor(), mounted.visible, mounted.camera.size)
    T_cam_board = mounted.T_cam_rig @ T_rig_frame @ T_frame_board
    return BoardImage(
        exposure.expose(ideal, rng), mounted.camera.project(se3.apply(T_cam_board, board.points)), T_cam_board
    )


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
