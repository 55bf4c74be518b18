"""View of a camera: does it see the world in a mirror or directly through a lens?

A flat checkerboard appears the same either way: its poses are then mirror images of each other. Markers show it, which
a mirror reflects, and so does the rim of a mirror with the dark hub in its middle, where the camera sees itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np

from calib.boards.aprilgrid import AprilGrid
from calib.boards.board import Board, BoardView
from calib.models.ocam import VIEWS, View
from calib.rim import find_rim
from omnid.calibration.board_search import Progress
from omnid.calibration.images import Images, brightest, middle_px
from omnid.errors import OmnidError

ViewChoice = Literal["auto", "mirror", "direct"]
VIEW_CHOICES: Final[tuple[ViewChoice, ...]] = ("auto", *VIEWS)


def view_of_images(
    choice: ViewChoice,
    cameras: Sequence[tuple[Images, Sequence[BoardView]]],
    board: Board | AprilGrid,
    progress: Progress,
) -> tuple[View, list[str]]:
    """Return the chosen view, or the one that the images of a rig's cameras and their views of the board show.

    With it comes a warning where the images show another view than the chosen one: the world would be its mirror image.
    Raises OmnidError for "auto" where the images show no view, or where they contradict each other.
    """
    if choice not in VIEW_CHOICES:
        raise OmnidError(f"view: expected one of {', '.join(VIEW_CHOICES)}, found {choice!r}")
    shown = {found for images, views in cameras if (found := _view_of_camera(images, views, board)) is not None}
    if choice != "auto":
        warning = (
            f"the view is given as {choice}, but the images do not look like that: where it is wrong, left and right "
            "are exchanged in all that follows; leave --view out unless you are sure"
        )
        return choice, [] if shown <= {choice} else [warning]
    if len(shown) != 1:
        words = (
            "a mirror in one and a lens in the other camera" if shown else "no markers and no mirror's rim with a hub"
        )
        raise OmnidError(
            "calibrate: the images do not show whether the world is seen in a mirror or through a lens (found "
            f"{words}): add --view mirror or --view direct"
        )
    (view,) = shown
    progress(f"view: {view}, as the images show")
    return view, []


def _view_of_camera(images: Images, views: Sequence[BoardView], board: Board | AprilGrid) -> View | None:
    """Return the view of one camera by its images and its views of the board; None: undecided."""
    if isinstance(board, Board):
        image = brightest(images.values())
        rim = find_rim(image, middle_px(image))
        return "mirror" if rim is not None and rim.inner_px > 0 else None
    # The grid's y points up in an image that is not reflected, the pixels' v down.
    reflected = []
    for view in views:
        seen = np.isfinite(view.pixels[:, 0])
        known = np.column_stack([board.points[seen, :2], np.ones(seen.sum())])
        affine = np.linalg.lstsq(known, view.pixels[seen], rcond=None)[0]
        reflected.append(np.linalg.det(affine[:2]) > 0)
    if not reflected:
        return None
    return "mirror" if 2 * sum(reflected) > len(reflected) else "direct"
