"""The view, mirror or lens, by tags or by rim and hub; what the images leave open is asked for."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.aprilgrid import AprilGrid, find_april_grid
from calib.boards.board import Board, BoardView
from calib.validation import silent
from omnid.calibration.images import Images
from omnid.calibration.view_guess import ViewChoice, view_of_images
from omnid.errors import OmnidError
from tests.simulation.april_grids import print_of

CHECKERBOARD = Board(6, 5, 0.03)
Camera = tuple[Images, list[BoardView]]  # its images, and what was found in them


def rim(hub_px: float, side: int = 240) -> Camera:
    """Return a camera that shows a light circle with a dark hub in a dark image, and no board."""
    v, u = np.indices((side, side)) - (side - 1) / 2
    radius = np.hypot(u, v)
    return {"a": np.where((radius < 0.45 * side) & (radius >= hub_px), 150, 8).astype(np.uint8)}, []


PLAIN: Camera = ({"a": np.full((480, 640), 150, np.uint8)}, [])


@pytest.mark.parametrize("view", ["mirror", "direct"])
def test_tags_are_reflected_by_a_mirror(view: str) -> None:
    board = AprilGrid(5, 4, 0.08, 0.3)
    sheet = print_of(board)
    seen: list[Camera] = []
    for turns in range(2):  # two cameras; the second one sees the board on its side
        turned = np.ascontiguousarray(np.rot90(sheet if view == "direct" else sheet[:, ::-1], turns))
        found = find_april_grid(turned, board)
        assert found is not None
        seen.append((rim(0.0)[0], [found]))
    assert view_of_images("auto", seen, board, silent) == (view, [])


@pytest.mark.parametrize(
    ("choice", "cameras", "chosen", "is_warned"),
    [
        ("auto", [rim(25.0), rim(25.0)], "mirror", False),
        ("auto", [rim(25.0), rim(0.0)], "mirror", False),
        ("mirror", [rim(25.0), PLAIN], "mirror", False),
        ("direct", [rim(25.0), PLAIN], "direct", True),
        ("direct", [PLAIN, PLAIN], "direct", False),
    ],
)
def test_rim_and_hub_of_a_mirror_show_it(
    choice: ViewChoice, cameras: list[Camera], chosen: str, is_warned: bool
) -> None:
    found, warnings = view_of_images(choice, cameras, CHECKERBOARD, silent)
    assert found == chosen and ("given as direct" in "".join(warnings)) == is_warned


# A mirror without a hub or a fisheye lens; a part of a mirror or a lens.
@pytest.mark.parametrize("camera", [rim(0.0), PLAIN])
def test_what_the_images_leave_open_is_asked_for(camera: Camera) -> None:
    with pytest.raises(OmnidError, match=r"\(found no markers.*add --view mirror or --view direct"):
        view_of_images("auto", [camera, camera], CHECKERBOARD, silent)
