"""View of a camera: does it see the world in a mirror or directly through a lens? From images of a board.

A flat checkerboard appears the same either way: its poses are then mirror images of each other. It is decided by:

- markers, which a mirror reflects;
- the rim of a mirror with the dark hub in its middle, where the camera sees itself;
- an image that shows the world to all four corners and in the middle, which no rim of a mirror bounds.

A circle without a hub may be a mirror or a fisheye lens.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, Literal

import numpy as np

from calib.boards.board import Board, BoardView
from calib.boards.marker_board import MarkerBoard
from calib.masks.rim import find_rim
from calib.models.camera import Array
from calib.models.ocam import VIEWS, View
from omnid.calibration.images import Image
from omnid.calibration.progress import Progress
from omnid.errors import OmnidError

ViewChoice = Literal["auto", "mirror", "direct"]
VIEW_CHOICES: Final[tuple[ViewChoice, ...]] = ("auto", *VIEWS)
VIEW_HELP: Final = (
    "the world is seen in a mirror or directly through a lens; auto (default): what markers, or rim and hub of a "
    "mirror, or an image without a rim show; else it must be given, as a checkerboard looks the same"
)
# Share of the views whose markers must agree: a single view may be misread.
AGREED: Final = 0.8
# Side of the patches in the corners and in the middle, in parts of the smaller side of the image; their least
# brightness in parts of the median of the image, to which a lens shades its corners; and the least grey level of that
# median, below which dark and light are not distinguished.
PATCH: Final = 1 / 16
LIT: Final = 0.4
LIGHT_GREY: Final = 40.0


def view_of_images(
    choice: ViewChoice,
    cameras: Sequence[tuple[Iterable[Image], Sequence[BoardView]]],
    board: Board | MarkerBoard,
    progress: Progress,
) -> View:
    """Return the chosen view, or the one that the images of a rig's cameras and their views of the board show.

    Raises OmnidError where none of them shows it, or where they contradict each other.
    """
    if choice != "auto":
        return choice
    shown = {_view_of_markers(views, board) or _view_of_image(_brightest(images)) for images, views in cameras} - {None}
    if len(shown) != 1:
        found = "a mirror in one and a lens in the other camera" if shown else "no markers, no mirror's rim with a hub"
        raise OmnidError(
            "calibrate: the images do not show whether the world is seen in a mirror or through a lens (found "
            f"{found}): add --view mirror or --view direct"
        )
    (view,) = shown
    assert view is not None
    progress(f"view: {view}, as the images show")
    return view


def _view_of_markers(views: Sequence[BoardView], board: Board | MarkerBoard) -> View | None:
    """Return the view by the handedness of a board with markers; None without markers, or where they disagree."""
    if isinstance(board, Board) or not views:
        return None
    # The corners of a marker go round clockwise in an image that is not reflected: u right, v down, a positive area.
    clockwise = _area(board.markers.corners[0]) > 0
    reflected = float(np.mean([(_orientation(board.points[:, :2], view.pixels) > 0) != clockwise for view in views]))
    if 1 - AGREED < reflected < AGREED:
        return None
    return "mirror" if reflected >= AGREED else "direct"


def _area(polygon: Array) -> float:
    """Return the signed area of a polygon (N, 2): positive where x turns to y."""
    x, y = polygon.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _orientation(points: Array, pixels: Array) -> float:
    """Return the determinant of the affine mapping from points (N, 2) of the board to pixels (N, 2), NaN for unseen."""
    seen = np.isfinite(pixels[:, 0])
    known = np.column_stack([points[seen], np.ones(seen.sum())])
    return float(np.linalg.det(np.linalg.lstsq(known, pixels[seen], rcond=None)[0][:2]))


def _brightest(images: Iterable[Image]) -> Image:
    return np.asarray(np.max(np.stack(list(images)), axis=0), np.uint8)


def _view_of_image(image: Image) -> View | None:
    """Return the view that the maximum (H, W) of a camera's images shows; None where it may be either."""
    height, width = image.shape
    rim = find_rim(image, ((width - 1) / 2, (height - 1) / 2))
    if rim is not None:
        return "mirror" if rim.inner_px > 0 else None
    side = max(4, round(PATCH * min(height, width)))
    top, left = (height - side) // 2, (width - side) // 2
    corners = [image[:side, :side], image[:side, -side:], image[-side:, :side], image[-side:, -side:]]
    darkest = min(float(np.median(patch)) for patch in [*corners, image[top : top + side, left : left + side]])
    median = float(np.median(image))
    return "direct" if median >= LIGHT_GREY and darkest >= LIT * median else None
