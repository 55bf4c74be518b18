"""View of a camera: does it see the world in a mirror or directly through a lens? From images of a board.

A flat checkerboard appears the same either way: its poses are then mirror images of each other. It is decided by:

- markers, which a mirror reflects;
- the rim of a mirror with the dark hub in its middle, where the camera sees itself;
- straight lines of the board that stay straight off the axis, which no convex mirror leaves so;
- boards that grow towards the rim, more than a right angle from the axis, as in paraboloids and hyperboloids: lenses
  that see so far keep them as large or make them smaller there.

Other circles without a hub may be a mirror or a fisheye lens, and so may images without a rim whose lines are bent: the
part of a mirror inside its rim looks like that.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards.board import Board, BoardView
from calib.boards.marker_board import MarkerBoard
from calib.errors import CalibError
from calib.fit.boards.camera_fit import BAD_LINEAR_RAD, consistent_views, observations
from calib.fit.boards.camera_models import DEGREE
from calib.fit.boards.ocam_linear import powers, solve_linear
from calib.masks.rim import find_rim
from calib.models.camera import Array
from calib.models.ocam import VIEWS, View
from omnid.calibration.board_search import Progress
from omnid.calibration.images import Image, brightest, middle_px
from omnid.errors import OmnidError

ViewChoice = Literal["auto", "mirror", "direct"]
VIEW_CHOICES: Final[tuple[ViewChoice, ...]] = ("auto", *VIEWS)
VIEW_HELP: Final = (
    "the world is seen in a mirror or directly through a lens; auto (default): what markers, or rim and hub of a "
    "mirror, or lines that a lens leaves straight, or boards that a mirror's rim enlarges show; else it must be given, "
    "as a checkerboard looks the same"
)
# Share of the views whose markers must agree: a single view may be misread.
AGREED: Final = 0.8
# A mirror bends lines by 0.11 to 0.14 of the radius at 40 degrees from the axis (unified model, xi of 0.8 to 1; a
# parabola, xi = 1, has tan^2(angle / 2)), lenses that are not fisheyes by 0.03: half of the parabola's is between them.
BENT_PART: Final = 0.5
MAX_ANGLE_RAD: Final = np.deg2rad(50)  # from the axis; beyond it the one coefficient does not describe a mirror
# Corners are found to 0.1 to 0.3 px; in a part of a mirror beside its middle the fit fails by 0.5 to 5 px.
MAX_RMS_PX: Final = 0.5
MIN_VIEWS, MIN_CORNERS = 3, 8  # for a fit of focal length and bend
# At 95 degrees from the axis the radius grows with this power of the angle: 1.7 in a paraboloid and more in
# hyperboloids, 1 and less in lenses of more than half a sphere and in balls. The limit is half way.
FAR_RAD: Final = np.deg2rad(95)
MIN_POWER: Final = 1.33
FIXED: Final = (
    cv2.CALIB_USE_INTRINSIC_GUESS
    | cv2.CALIB_FIX_PRINCIPAL_POINT
    | cv2.CALIB_FIX_ASPECT_RATIO
    | cv2.CALIB_ZERO_TANGENT_DIST
    | cv2.CALIB_FIX_K2
    | cv2.CALIB_FIX_K3
)


def view_of_images(
    choice: ViewChoice,
    cameras: Sequence[tuple[Iterable[Image], Sequence[BoardView]]],
    board: Board | MarkerBoard,
    progress: Progress,
) -> tuple[View, list[str]]:
    """Return the chosen view, or the one that the images of a rig's cameras and their views of the board show.

    With it comes a warning where the images show another view than the chosen one: the world would be its mirror image.
    Raises OmnidError for "auto" where the images show no view, or where they contradict each other.
    """
    if choice not in VIEW_CHOICES:
        raise OmnidError(f"view: expected one of {', '.join(VIEW_CHOICES)}, found {choice!r}")
    shown = _views_shown(cameras, board)
    if choice != "auto":
        warning = (
            f"the view is given as {choice}, but the images do not look like that: where it is wrong, left and right "
            "are exchanged in all that follows; leave --view out unless you are sure"
        )
        return choice, [] if shown <= {choice} else [warning]
    if len(shown) != 1:
        found = "no markers, no mirror's rim with a hub, no straight lines of a lens, no boards that a rim enlarges"
        if shown:
            found = "a mirror in one and a lens in the other camera"
        raise OmnidError(
            "calibrate: the images do not show whether the world is seen in a mirror or through a lens (found "
            f"{found}): add --view mirror or --view direct"
        )
    (view,) = shown
    progress(f"view: {view}, as the images show")
    return view, []


def _views_shown(
    cameras: Sequence[tuple[Iterable[Image], Sequence[BoardView]]], board: Board | MarkerBoard
) -> set[View]:
    """Return the views that the images of cameras show; empty where they are undecided."""
    shown = (_view_of_camera(brightest(images), views, board) for images, views in cameras)
    return {view for view in shown if view is not None}


def _view_of_camera(image: Image, views: Sequence[BoardView], board: Board | MarkerBoard) -> View | None:
    """Return the view of one camera by the maximum of its images and its views of the board; None: undecided."""
    size = (image.shape[1], image.shape[0])
    return (
        _view_of_markers(views, board)
        or _view_of_image(image)
        or _view_of_lines(size, views, board)
        or _view_of_profile(size, views, board)
    )


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


def _view_of_image(image: Image) -> View | None:
    """Return "mirror" where the maximum (H, W) of a camera's images has a rim and a hub."""
    rim = find_rim(image, middle_px(image))
    return "mirror" if rim is not None and rim.inner_px > 0 else None


def _view_of_lines(size: tuple[int, int], views: Sequence[BoardView], board: Board | MarkerBoard) -> View | None:
    """Return "direct" where the board is seen as by a pinhole, bent less than any mirror bends it; size (w, h)."""
    # 1. Fit a pinhole with one coefficient, r_seen = r (1 + k r^2), about the middle of the image.
    points, pixels = list[NDArray[np.float32]](), list[NDArray[np.float32]]()
    for view in views:
        seen = np.isfinite(view.pixels[:, 0])
        if seen.sum() >= MIN_CORNERS:
            points.append(board.points[seen].astype(np.float32))
            pixels.append(view.pixels[seen].astype(np.float32))
    if len(pixels) < MIN_VIEWS:
        return None
    centre = (np.array(size) - 1) / 2
    K = np.array([[size[0], 0, centre[0]], [0, size[0], centre[1]], [0, 0, 1.0]])
    try:
        rms_px, K, bends, _, _ = cv2.calibrateCamera(points, pixels, size, K, np.zeros(5), flags=FIXED)
    except cv2.error:
        return None
    k = float(np.ravel(bends)[0])
    if not (rms_px <= MAX_RMS_PX and np.isfinite(k)):
        return None
    # 2. Compare its bend, at the corner that is the farthest from the axis, with that of a mirror.
    farthest = max(float(np.linalg.norm(one - centre, axis=1).max()) for one in pixels) / K[0, 0]
    r = np.linspace(0, np.tan(MAX_ANGLE_RAD), 1000)
    r = r[r * (1 + k * r**2) <= farthest][-1]
    return "direct" if -k * r**2 < BENT_PART * np.tan(np.arctan(r) / 2) ** 2 else None


def _view_of_profile(size: tuple[int, int], views: Sequence[BoardView], board: Board | MarkerBoard) -> View | None:
    """Return "mirror" where boards FAR_RAD from the axis are as large as only a mirror shows them; size (w, h).

    The profile is the same for both views: the poses of a flat board are mirror images of each other.
    """
    # 1. The profile f of the rays (x, y, f(rho)), by boards that agree.
    try:
        good, _ = consistent_views(views, board, size, "mirror")
    except CalibError:
        return None
    observed = observations(good, board)
    solved = solve_linear(observed, size, DEGREE, "mirror")
    if float(np.median(solved.errors_rad)) > BAD_LINEAR_RAD or solved.coefficients[0] >= 0:
        return None
    # 2. The power n of rho ~ angle^n, n = angle / (rho d angle / d rho), at the first radius that far from the axis.
    seen = np.linalg.norm(observed.pixels[..., ::-1] - solved.center, axis=-1)
    rho = np.linspace(0, float(np.nanmax(seen)) / solved.scale_px, 1000)[1:]
    f = rho[:, None] ** powers(DEGREE) @ solved.coefficients / solved.scale_px
    angle = np.arctan2(rho, -f)
    if angle[-1] < FAR_RAD:
        return None
    power = angle / (rho * np.gradient(angle, rho))
    return "mirror" if power[np.argmax(angle >= FAR_RAD)] >= MIN_POWER else None
