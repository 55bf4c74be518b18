"""Calibration of a rig by a board that both cameras see at once: `omnid.calibrate_rig`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path

import numpy as np

from calib import se3
from calib.boards.board import BoardView
from calib.boards.marker_board import AprilGrid
from calib.boards.print_shape import AS_DRAWN, PrintShape
from calib.camera_file import CameraFile
from calib.fit.boards.camera_fit import RejectedView
from calib.fit.boards.camera_selection import ModelChoice
from calib.fit.boards.rig_covariance import rig_covariance
from calib.fit.boards.rig_fit import RigCalibration, fit_rig, refine_rig_calibration, rig_print_shape
from calib.fit.boards.rig_problem import PairView
from calib.fit.boards.rig_selection import select_rig
from calib.fit.rig_uncertainty import DriveUncertainty, drive_uncertainty
from calib.models.names import sees_directly
from calib.rig import Rig
from calib.rig_file import write_file, write_rig
from calib.rig_frame import is_turned_over
from omnid.calibration.accuracy_notes import GOOD_PART, MISFIT_PART, accuracy_warnings
from omnid.calibration.board_search import AnyBoard, find_boards, select_diverse_views
from omnid.calibration.image_pairs import SIDES, PairedImages, read_pairs
from omnid.calibration.images import Image, Images
from omnid.calibration.missing_views import missing_views
from omnid.calibration.progress import Progress, silent
from omnid.calibration.rig_cameras import FittedCameras, fit_cameras
from omnid.calibration.rig_masks import masked_rig
from omnid.calibration.rig_report import rig_report_html
from omnid.calibration.view_guess import ViewChoice, view_of_images
from omnid.errors import OmnidError

# The board scales the rig: a baseline outside this range, from smaller than any mirror to larger than any vehicle,
# shows a wrong length of the board.
BASELINE_RANGE_M = (0.01, 3.0)
# Relative difference from the baseline by ruler. A tenth is no error of a ruler; 2 % are 4 mm of 200 mm.
REFUSED_PART, WARNING_PART = 0.1, 0.02
GivenCameras = tuple[CameraFile, CameraFile]
FitEach = Callable[[list[PairView], PrintShape], FittedCameras]  # Each camera by its views of a board of that shape.


@dataclass(frozen=True, slots=True)
class RigResult:
    """A calibrated rig with its masks and covariance, and the images that it was fitted to."""

    rig: Rig
    calibration: RigCalibration
    images: PairedImages
    notes: tuple[str, ...]  # about repeated images, baseline, view, order of the cameras, and masks that are missing
    drives: DriveUncertainty | None  # errors of drives by the covariance; None if the cameras were given
    missing: str  # which pairs to add

    @property
    def is_misfit(self) -> bool:
        """True if a camera model leaves more than noise, and drives may be wrong by MISFIT_PART because of it."""
        costly = self.drives is None or self.drives.length_part >= MISFIT_PART
        return costly and any(self.calibration.structure(side).is_misfit for side in range(len(SIDES)))

    @property
    def warnings(self) -> list[str]:
        """Limits of the result, one line each."""
        found = self.calibration
        return [
            *accuracy_warnings([found.structure(side) for side in range(len(SIDES))], self.drives, self.missing),
            *found.shape.notes(found.board.points),
            *self.notes,
            *(f"left out {bad.name}: {bad.reason}" for bad in found.rejected),
        ]

    def __str__(self) -> str:
        found = self.calibration
        rotation_deg = np.rad2deg(np.linalg.norm(se3.rotation_log(found.T_upper_lower[:3, :3])))
        sigma_deg = np.rad2deg(np.linalg.norm(found.motion_sigma[3:]))
        single_views = len(found.views) - found.pairs
        return (
            f"{'MISFIT: ' if self.is_misfit else ''}baseline {found.baseline_m * 1e3:.2f} mm (sigma "
            f"{found.baseline_sigma_m * 1e3:.2f}), upper rotated by {rotation_deg:.3f} deg (sigma {sigma_deg:.3f}),"
            f" mean reprojection error {found.fit.mean_px:.3f} px, {found.pairs} pairs"
            + (f", {single_views} views of one camera alone" if single_views else "")
            + (f"; drives: {self.drives}" if self.drives else "")
            + (f", good for {GOOD_PART:.1%} of length" if self.drives and self.drives.length_part <= GOOD_PART else "")
        )

    def save(self, path: str | PathLike[str]) -> None:
        """Write the rig.toml, and masks with struts to PNGs in the same folder."""
        write_rig(Path(path), self.rig)

    def save_report(self, path: str | PathLike[str]) -> None:
        """Write an HTML page with residuals, coverage and panoramas."""
        write_file(Path(path), rig_report_html(self.calibration, self.images, self.rig).encode())


def calibrate_rig(
    source: str | PathLike[str],
    board: AnyBoard,
    *,
    topics: tuple[str | None, str | None] = (None, None),
    cameras: GivenCameras | None = None,
    refine_cameras: bool = False,
    model: ModelChoice = "auto",
    view: ViewChoice = "auto",
    with_struts: bool = False,
    expected_baseline_m: float | None = None,
    progress: Progress = silent,
) -> RigResult:
    """Calibrate two cameras and the transform between them by images of a board.

    source: a log of both cameras with the topics of the lower and the upper one, or a folder with images lower_*,
    upper_*. cameras: known cameras, which stay as they are unless refine_cameras. model, view, progress: as in
    `calibrate_camera`. with_struts: masks with hub and struts, not only the rim. expected_baseline_m: by ruler; a
    result that differs by a tenth is refused. Raises OmnidError or CalibError where the images do not suffice.
    """
    # 1. Read the images, each once.
    images = _read(Path(source), topics, cameras)
    for line in images.notes:
        progress(line)
    # 2. Find the board in all of them.
    views = _find_views(images, board, progress)
    # 3. Find the view of the cameras, that of a mirror or of a lens, unless the cameras are known.
    fit_each: FitEach
    if cameras is None:
        direction, shown = view_of_images(view, _by_camera(images, views), board, progress)
        fit_each = partial(fit_cameras, images, board, model, direction, progress)
    else:
        fit_each, shown = (lambda seen, _: FittedCameras.known(cameras, seen)), []
    # 4. Fit the cameras, and the transform between them.
    refined = cameras is None or refine_cameras
    found = _fit(views, images, board, fit_each, refined, progress)
    # 5. Compare the baseline with what it can be.
    notes = [*images.notes, *_check_baseline(found, board, expected_baseline_m), *shown]
    # 6. Build the rig with masks and covariance, and predict the errors of drives.
    return _result(found, images, cameras, notes, with_struts=with_struts, refined=refined)


def _fit(
    views: list[PairView],
    images: PairedImages,
    board: AnyBoard,
    fit_each: FitEach,
    refined: bool,
    progress: Progress,
) -> RigCalibration:
    """Fit each camera and the transform between them; where refined, the cameras once more with the transform."""
    # 1. Fit each camera to all its views.
    single = fit_each(views, AS_DRAWN)
    rejected = [] if refined else _views_of_one_camera(views)
    # 2. Fit the transform between the cameras, and the cameras with it.
    found = _fit_rig(single, board, refined, AS_DRAWN, progress)
    # 3. Refine the corners with the cameras, and fit the rig again.
    found = refine_rig_calibration(found, images.sides, refined)
    rejected += [*single.rejected, *found.rejected]
    # 4. If the print differs from its drawing, fit the cameras and the rig again with its shape.
    shape = rig_print_shape(found, refined)
    if not shape.is_as_drawn:
        progress("the board is not as drawn: once more with its shape")
        single = fit_each(list(found.views), shape)
        found = _fit_rig(single, board, refined, shape, progress)
        rejected += [*single.rejected, *found.rejected]
    return replace(found, rejected=tuple(rejected))


def _result(
    found: RigCalibration,
    images: PairedImages,
    cameras: GivenCameras | None,
    notes: Sequence[str],
    *,
    with_struts: bool,
    refined: bool,
) -> RigResult:
    """Return the result with the rig of a calibration: its masks, its covariance, and the errors of drives with it."""
    rig, unmasked = masked_rig(found, images, cameras, with_struts=with_struts)
    rig = replace(rig, covariance=rig_covariance(found, rig))
    drives = drive_uncertainty(rig) if refined else None
    missing = missing_views(found.views, rig) if drives else ""
    return RigResult(rig, found, images, (*notes, *_order_notes(rig), *unmasked), drives, missing)


def _read(
    source: Path,
    topics: tuple[str | None, str | None],
    cameras: GivenCameras | None,
) -> PairedImages:
    """Return the images of both cameras; OmnidError if the given cameras do not fit them."""
    images = read_pairs(source, *topics)
    return images if cameras is None else _of_sizes(images, cameras)


def _fit_rig(
    single: FittedCameras, board: AnyBoard, refined: bool, shape: PrintShape, progress: Progress
) -> RigCalibration:
    """Fit the transform between the cameras to their views, and the cameras with it if refined."""
    if not refined:
        return fit_rig(single.views, board, single.cameras, refined, shape)
    selected = select_rig(single.views, board, single.cameras, single.polynomials, shape)
    for number, score in enumerate(selected.scores):
        progress(f"rig: {'compared' if number else 'selected'} {score}")
    return selected.calibration


def _of_sizes(images: PairedImages, cameras: GivenCameras) -> PairedImages:
    """Return the images; raise OmnidError if known cameras are not those of them."""
    if sees_directly(cameras[0].camera) != sees_directly(cameras[1].camera):
        raise OmnidError(
            "calibrate rig: expected cameras of the same view, found one of a mirror and one of a lens; "
            "calibrate both with the same --view"
        )
    for name, side, file in zip(SIDES, images.sides, cameras, strict=True):
        height, width = next(iter(side.values())).shape
        if (width, height) != tuple(file.camera.size):
            raise OmnidError(
                f"--{name}-camera: expected a camera of {width}x{height} px like the {name} images, found "
                f"{file.camera.size[0]}x{file.camera.size[1]} px; give the file of this camera"
            )
    return images


def _find_views(images: PairedImages, board: AnyBoard, progress: Progress) -> list[PairView]:
    """Find the board in the images of both cameras; of a log's many pairs the most diverse ones are selected."""
    of_log = bool(images.topics[0])
    found = [
        _find_side(side, board, name, progress, thorough=not of_log)
        for name, side in zip(SIDES, images.sides, strict=True)
    ]
    both = [found[0][name] for name in images.names if name in found[0] and name in found[1]]
    selected = set(images.names)
    if of_log and both:
        selected = {view.name for view in select_diverse_views(both)}
    seen = [PairView(name, (found[0].get(name), found[1].get(name))) for name in images.names if name in selected]
    return [view for view in seen if any(view.seen)]


def _find_side(
    images: Images, board: AnyBoard, name: str, progress: Progress, *, thorough: bool
) -> dict[str, BoardView]:
    """Return the views of the board by the camera of that name, by the names of the images."""
    try:
        views = find_boards(images, board, thorough=thorough, progress=progress)
    except OmnidError as error:
        raise OmnidError(f"{name} camera: {error}") from error
    return {view.name: view for view in views}


def _by_camera(images: PairedImages, views: Sequence[PairView]) -> list[tuple[Iterable[Image], list[BoardView]]]:
    """Return the images of each camera, and its views of the board."""
    return [
        (own.values(), [seen for view in views if (seen := view.seen[side]) is not None])
        for side, own in enumerate(images.sides)
    ]


def _views_of_one_camera(views: list[PairView]) -> list[RejectedView]:
    """Return the views that a fit of known cameras cannot use."""
    return [
        RejectedView(view.name, f"only the {name} camera saw the board; with given cameras pairs are needed")
        for view in views
        for name, other in zip(SIDES, view.seen[::-1], strict=True)
        if other is None
    ]


def _check_baseline(found: RigCalibration, board: AnyBoard, expected_m: float | None) -> list[str]:
    """Return warnings about the baseline; raises OmnidError if it is far from the expected one."""
    baseline_mm, (low, high) = found.baseline_m * 1e3, BASELINE_RANGE_M
    option, length_mm = (
        ("--tag-mm", board.tag_m * 1e3) if isinstance(board, AprilGrid) else ("--square-mm", board.square_m * 1e3)
    )
    if not low <= found.baseline_m <= high:
        raise OmnidError(
            f"calibrate rig: expected a baseline of {low * 1e3:.0f} to {high * 1e3:.0f} mm, found {baseline_mm:.4g} "
            f"mm; it is proportional to {option}, which is {length_mm:g}: measure the board"
        )
    if expected_m is None:
        return []
    expected_mm = expected_m * 1e3
    off = baseline_mm / expected_mm - 1
    if abs(off) > REFUSED_PART:
        raise OmnidError(
            f"calibrate rig: expected a baseline of {expected_mm:g} mm, found {baseline_mm:.1f} mm; "
            f"{option} {length_mm * expected_mm / baseline_mm:.2f} would explain it: measure the board "
            f"({option} is {length_mm:g}) and the distance of the mirrors"
        )
    if abs(off) > WARNING_PART:
        return [f"the baseline of {baseline_mm:.2f} mm is {abs(off):.1%} off the expected {expected_mm:g} mm"]
    return []


def _order_notes(rig: Rig) -> list[str]:
    """Return a warning where the images of both cameras seem to be exchanged: the world would be upside down."""
    if not is_turned_over(rig):
        return []
    mounted = "stand upside down" if sees_directly(rig.lower.camera) else "look down into their mirrors"
    return [
        f"the upper camera is found below the lower one: exchange their images, unless the cameras {mounted}; "
        "the rig's z would point down"
    ]
