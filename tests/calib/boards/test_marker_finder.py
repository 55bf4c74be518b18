"""Boards with markers: layouts, detection in rendered mirror images, hidden parts, misread markers."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.marker_board import AprilGrid, CharucoBoard, MarkerBoard
from calib.boards.marker_finder import find_marker_board
from calib.boards.marker_reading import seen_dictionary
from calib.models.camera import Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera
from omnid.simulation.rendering.sensor import Sensor
from tests.simulation.boards import BoardImage, board_poses_around_camera
from tests.simulation.marker_boards import frame_board, print_of, render_marker_board

MOUNTED = MountedCamera(
    UnifiedCamera(0.9, (-150.0, 151.0), (241.3, 237.8), (480, 480)), np.eye(4), Mask((241.3, 237.8), 40.0, 232.0)
)
CHARUCO = CharucoBoard(6, 5, 0.05, 0.0375, "4X4_50")
GRID = AprilGrid(4, 3, 0.06, 0.3)
FEW_MARKERS = CharucoBoard(4, 3, 0.05, 0.0375, "4X4_50")  # each costs a comparison with thousands of others


def rendered(board: MarkerBoard, hidden: float = 0.0) -> BoardImage:
    mask = MOUNTED.mask
    assert mask is not None
    T = board_poses_around_camera(MOUNTED.camera, frame_board(board), mask, 1, seed=3, distance_m=(0.25, 0.3))[0]
    return render_marker_board(MOUNTED, board, T, seed=1, sensor=Sensor(noise_sigma=2.0), hidden=hidden)


@pytest.mark.parametrize(
    ("board", "hidden", "least", "most"),
    [(CHARUCO, 0.0, 0.7, 1.0), (CHARUCO, 0.5, 0.25, 0.55), (GRID, 0.0, 0.7, 1.0), (GRID, 0.5, 0.25, 0.55)],
)
def test_finds_the_visible_corners_in_a_mirror(board: MarkerBoard, hidden: float, least: float, most: float) -> None:
    made = rendered(board, hidden)
    view = find_marker_board(made.image, board, "name")
    assert view is not None and view.name == "name" and least <= view.confidence <= most
    off = np.linalg.norm(view.pixels - made.corners, axis=1)
    assert np.isfinite(off).mean() == view.confidence
    assert np.nanmedian(off) < 0.05 and np.nanpercentile(off, 90) < 0.3


def test_another_dictionary_is_no_board_and_named() -> None:
    """In the mirror image of a print: in a rendered image a search that finds nothing tries all specks of noise."""
    image = np.ascontiguousarray(print_of(FEW_MARKERS)[0][:, ::-1])
    assert find_marker_board(image, CharucoBoard(4, 3, 0.05, 0.0375, "6X6_50")) is None
    assert find_marker_board(image, GRID) is None
    assert find_marker_board(image, FEW_MARKERS) is not None
    assert seen_dictionary(image, 1) == "4X4_50"
    assert seen_dictionary(np.full((100, 100), 90, np.uint8), 1) is None
