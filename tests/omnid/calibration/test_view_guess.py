"""The view, mirror or lens, by markers, rim and hub, or an image without a rim; asked for where nothing shows it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.boards.board import Board, BoardView
from calib.boards.marker_board import AprilGrid, CharucoBoard, MarkerBoard
from calib.boards.marker_finder import find_marker_board
from omnid.calibration.progress import silent
from omnid.calibration.view_guess import view_of_images
from omnid.errors import OmnidError
from tests.simulation.marker_boards import print_of

CHECKERBOARD = Board(6, 5, 0.03)
Image = NDArray[np.uint8]


def disc(hub_px: float, side: int = 240) -> Image:
    """Return a light circle with a dark hub in a dark image."""
    v, u = np.indices((side, side)) - (side - 1) / 2
    radius = np.hypot(u, v)
    return np.where((radius < 0.45 * side) & (radius >= hub_px), 150, 8).astype(np.uint8)


def shaded(corner: float, side: int = 240) -> Image:
    """Return an image whose brightness falls to a part of that of its middle in the corners."""
    v, u = (np.indices((side, side)) - (side - 1) / 2) / ((side - 1) / 2)
    return np.asarray(160 * (1 - (1 - corner) * (u**2 + v**2) / 2), np.uint8)


def guess(*images: Image) -> str:
    return view_of_images("auto", [([image], []) for image in images], CHECKERBOARD, silent)


@pytest.mark.parametrize("board", [CharucoBoard(7, 5, 0.06, 0.045, "4X4_50"), AprilGrid(5, 4, 0.08, 0.3)])
@pytest.mark.parametrize("view", ["mirror", "direct"])
def test_markers_are_reflected_by_a_mirror(board: MarkerBoard, view: str) -> None:
    sheet = print_of(board)[0]
    seen: list[tuple[list[Image], list[BoardView]]] = []
    for turns in range(2):  # two cameras; the second one sees the board on its side
        turned = np.ascontiguousarray(np.rot90(sheet if view == "direct" else sheet[:, ::-1], turns))
        found = find_marker_board(turned, board)
        assert found is not None
        seen.append(([disc(0.0)], [found]))
    assert view_of_images("auto", seen, board, silent) == view


def test_a_rim_with_a_hub_is_a_mirror_and_an_image_without_a_rim_a_lens() -> None:
    assert guess(disc(25.0)) == "mirror" and guess(disc(25.0), disc(0.0)) == "mirror"
    assert guess(shaded(0.5)) == "direct"


@pytest.mark.parametrize(
    ("images", "found"),
    [
        ([disc(0.0)], "no markers"),  # a mirror without a hub, or a fisheye
        ([shaded(0.2)], "no markers"),  # neither a rim nor light corners
        ([shaded(0.5) // 8], "no markers"),  # dark
        ([disc(25.0), shaded(0.5)], "a mirror in one"),
    ],
)
def test_what_the_images_leave_open_is_asked_for(images: list[Image], found: str) -> None:
    with pytest.raises(OmnidError, match=rf"\(found {found}.*add --view mirror or --view direct"):
        guess(*images)
    assert view_of_images("direct", [(images, [])], CHECKERBOARD, silent) == "direct"
