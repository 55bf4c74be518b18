"""The view, mirror or lens, by markers; what the images leave open is asked for."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import Board, BoardView
from calib.boards.marker_board import AprilGrid, CharucoBoard, MarkerBoard
from calib.boards.marker_finder import find_marker_board
from calib.models.camera import Mask, OmniCamera
from calib.models.lens import EquidistantCamera
from calib.models.unified import UnifiedCamera
from omnid.calibration.board_search import silent
from omnid.calibration.view_guess import ViewChoice, view_of_images
from omnid.errors import OmnidError
from tests.simulation.boards import board_pose, board_poses_around_camera
from tests.simulation.marker_boards import print_of

CHECKERBOARD = Board(6, 5, 0.03)
Image = NDArray[np.uint8]
Camera = tuple[list[Image], list[BoardView]]  # its images, and what was found in them


def rim(hub_px: float, side: int = 240) -> Camera:
    """Return a camera that shows a light circle with a dark hub in a dark image, and no board."""
    v, u = np.indices((side, side)) - (side - 1) / 2
    radius = np.hypot(u, v)
    return [np.where((radius < 0.45 * side) & (radius >= hub_px), 150, 8).astype(np.uint8)], []


def seen_boards(focal_px: float, xi: float, k: float = 0.0, *, sigma_px: float = 0.15) -> Camera:
    """Return a camera of 640x480 px without a rim, and its views of boards, as the unified model shows them.

    xi 0: a pinhole lens, whose lines k bends; 0.8 to 1: the part of a mirror inside its rim.
    """
    rng, views = np.random.default_rng(4), list[BoardView]()
    while len(views) < 10:
        angle, off_axis = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.8)
        middle = [np.sin(off_axis) * np.cos(angle), np.sin(off_axis) * np.sin(angle), np.cos(off_axis)]
        T = board_pose(np.array(middle), rng.uniform(0.25, 0.5), rng.uniform(-0.5, 0.5, 3), CHECKERBOARD)
        rays = se3.apply(T, CHECKERBOARD.points)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        plane = (1 + xi) * rays[:, :2] / (rays[:, 2:] + xi)
        plane *= 1 + k * (plane**2).sum(axis=1, keepdims=True)
        pixels = focal_px * plane + [319.5, 239.5] + sigma_px * rng.standard_normal(plane.shape)
        if ((pixels > 5) & (pixels < [635, 475])).all():
            views.append(BoardView(str(len(views)), pixels))
    return [np.full((480, 640), 150, np.uint8)], views


def boards_around(camera: OmniCamera, farthest_deg: float = 105.0) -> Camera:
    """Return a camera of a rim without a hub, and its views of boards whose middles are so far from the axis."""
    rng, board, mask = np.random.default_rng(5), CHECKERBOARD, Mask(camera.center, 0.0, 300.0)
    around = board_poses_around_camera(camera, board, mask, 8, distance_m=(0.2, 0.4), elevation_deg=(30, farthest_deg))
    seen = [camera.project(se3.apply(T, board.points)) for T in around]
    return rim(0.0, 640)[0], [BoardView("", pixels + 0.15 * rng.standard_normal(pixels.shape)) for pixels in seen]


def mirror(xi: float, focal_px: float) -> UnifiedCamera:
    """Return a mirror by the unified model: xi of 1 a paraboloid, below it a hyperboloid; a ball is like one of 3."""
    return UnifiedCamera(xi, (-focal_px, focal_px), (321.0, 317.0), (640, 640))


FISHEYE = EquidistantCamera((0.02, 0.0, 0.0, 0.0), (120.0, 120.0), (321.0, 317.0), (640, 640))


def guess(*cameras: Camera) -> str:
    return view_of_images("auto", cameras, CHECKERBOARD, silent)[0]


@pytest.mark.parametrize("board", [CharucoBoard(7, 5, 0.06, 0.045, "4X4_50"), AprilGrid(5, 4, 0.08, 0.3)])
@pytest.mark.parametrize("view", ["mirror", "direct"])
def test_markers_are_reflected_by_a_mirror(board: MarkerBoard, view: str) -> None:
    sheet = print_of(board)[0]
    seen: list[Camera] = []
    for turns in range(2):  # two cameras; the second one sees the board on its side
        turned = np.ascontiguousarray(np.rot90(sheet if view == "direct" else sheet[:, ::-1], turns))
        found = find_marker_board(turned, board)
        assert found is not None
        seen.append((rim(0.0)[0], [found]))
    assert view_of_images("auto", seen, board, silent) == (view, [])


@pytest.mark.parametrize(
    ("cameras", "found"),
    [
        ([rim(0.0)], "no markers"),  # a mirror without a hub, or a fisheye
        ([boards_around(FISHEYE)], "no markers"),
        ([boards_around(mirror(3.0, 200.0))], "no markers"),  # a ball
        ([boards_around(mirror(1.0, 160.0), 60.0)], "no markers"),  # boards near the axis only
        ([seen_boards(1000, 0.8)], "no markers"),  # inside the rim of a mirror: 19 degrees about its axis,
        ([seen_boards(500, 0.9)], "no markers"),  # 36 degrees,
        ([seen_boards(300, 1.0)], "no markers"),  # and 55 degrees
        ([seen_boards(600, 0.0, sigma_px=3.0)], "no markers"),  # uncertain corners
        ([(seen_boards(600, 0.0)[0], seen_boards(600, 0.0)[1][:2])], "no markers"),  # too few views
        ([rim(25.0), seen_boards(600, 0.0)], "a mirror in one"),
    ],
)
def test_what_the_images_leave_open_is_asked_for(cameras: list[Camera], found: str) -> None:
    with pytest.raises(OmnidError, match=rf"\(found {found}.*add --view mirror or --view direct"):
        guess(*cameras)
    chosen, warnings = view_of_images("direct", cameras, CHECKERBOARD, silent)
    assert chosen == "direct" and len(warnings) == (found != "no markers")


def warnings_about(view: ViewChoice, *cameras: Camera) -> str:
    return "".join(view_of_images(view, cameras, CHECKERBOARD, silent)[1])


def test_a_view_that_the_images_contradict_is_a_warning() -> None:
    mirror, lens = rim(25.0), seen_boards(600, 0.0)
    assert "given as direct" in warnings_about("direct", mirror, rim(0.0))
    assert "given as mirror" in warnings_about("mirror", lens)
    assert (
        not warnings_about("mirror", mirror)
        and not warnings_about("direct", lens)
        and not warnings_about("auto", mirror)
    )
