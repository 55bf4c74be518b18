"""Calibration of a rig by a board that both cameras see at once: `omnid.calibrate_rig`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from calib import se3
from calib.atomic_file import write_file
from calib.boards.board import BoardView
from calib.boards.marker_board import AprilGrid
from calib.boards.print_shape import AS_DRAWN, PrintShape
from calib.fit.boards.camera_fit import RejectedView
from calib.fit.boards.camera_selection import ModelChoice, SelectedCalibration, refine_selection, select_calibration
from calib.fit.boards.rig_covariance import rig_covariance
from calib.fit.boards.rig_fit import RigCalibration, refine_rig_calibration, rig_print_shape
from calib.fit.boards.rig_problem import PairView
from calib.fit.boards.rig_selection import select_rig
from calib.fit.residual_structure import ResidualStructure
from calib.fit.rig_uncertainty import DriveUncertainty, drive_uncertainty
from calib.masks.rim import find_rim
from calib.masks.stack_mask import find_mask
from calib.models.camera import Mask
from calib.models.names import sees_directly
from calib.models.ocam import OcamCamera, View
from calib.rig import Rig
from calib.rig_file import write_rig
from calib.rig_frame import mounting_notes, rig_between
from drivers.logs.log_reader import AnyCameras, LogCameras
from omnid.calibration.angle_table import AngleRow, angle_lines, angle_rows, missing_boards
from omnid.calibration.board_search import AnyBoard, Progress, find_boards, select_diverse_views, silent
from omnid.calibration.images import SIDES, Image, Images, PairedImages, brightest, read_pairs
from omnid.calibration.rig_report import rig_report_html
from omnid.calibration.view_guess import ViewChoice, view_of_images
from omnid.errors import OmnidError

# The board scales the rig: a baseline outside this range, from smaller than any mirror to larger than any vehicle,
# shows a wrong length of the board.
BASELINE_RANGE_M = (0.01, 3.0)
# Relative difference from the baseline by ruler. A tenth is no error of a ruler; 2 % are 4 mm of 200 mm.
REFUSED_PART, WARNING_PART = 0.1, 0.02


@dataclass(frozen=True, slots=True)
class RigResult:
    """A calibrated rig with its masks and covariance, and the images that it was fitted to."""

    rig: Rig
    calibration: RigCalibration
    images: PairedImages
    notes: tuple[str, ...]  # about repeated images, baseline, view, order of the cameras, and masks that are missing
    drives: DriveUncertainty | None  # errors of drives by the covariance; None if the cameras see too little in common
    angles: tuple[tuple[AngleRow, ...], ...]  # residuals and coverage of the lower and the upper camera

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
            *accuracy_warnings(
                [found.structure(side) for side in range(len(SIDES))], self.drives, missing_boards(self.angles)
            ),
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

    @property
    def tables(self) -> list[str]:
        """Return the tables of residuals by the angle from the axis, in lines."""
        return [line for name, rows in zip(SIDES, self.angles, strict=True) for line in angle_lines(name, rows)]

    def save(self, path: str | PathLike[str]) -> None:
        """Write the rig.toml, and masks with struts to PNGs in the same folder."""
        write_rig(Path(path), self.rig)

    def save_report(self, path: str | PathLike[str]) -> None:
        """Write an HTML page with residuals, coverage and panoramas."""
        write_file(Path(path), rig_report_html(self.calibration, self.images, self.rig, self.angles).encode())


def calibrate_rig(
    source: str | PathLike[str],
    board: AnyBoard,
    *,
    topics: AnyCameras = (None, None),
    model: ModelChoice = "auto",
    view: ViewChoice = "auto",
    with_struts: bool = False,
    expected_baseline_m: float | None = None,
    progress: Progress = silent,
) -> RigResult:
    """Calibrate two cameras and the transform between them by images of a board.

    source: a log of both cameras with the topics of the lower and the upper one, or a folder with images lower_*,
    upper_*. model: "auto" fits every model and selects by cross-validation. view: the world is seen in a mirror or
    directly; "auto": as the images show, see `view_guess`. with_struts: masks with hub and struts, not only the rim.
    expected_baseline_m: by ruler; a result that differs by a tenth is refused. progress receives one line for each
    image and each model. Raises OmnidError or CalibError where the images do not suffice.
    """
    # 1. Read the images, each once.
    images = read_pairs(Path(source), LogCameras(*topics))
    for line in images.notes:
        progress(line)
    # 2. Find the board in all of them.
    views = _find_views(images, board, progress)
    # 3. Find the view of the cameras, that of a mirror or of a lens.
    direction, shown = view_of_images(view, _by_camera(images, views), board, progress)
    # 4. Fit the cameras, and the transform between them.
    found = _fit(views, images, board, (model, direction), progress)
    # 5. Compare the baseline with what it can be.
    baseline_notes = _check_baseline(found, board, expected_baseline_m)
    # 6. Build the rig with masks and covariance, and predict the errors of drives.
    rig, unmasked = _masked_rig(found, images, with_struts=with_struts)
    rig = replace(rig, covariance=rig_covariance(found, rig))
    drives = drive_uncertainty(rig)
    angles = tuple(tuple(angle_rows(found, rig, side)) for side in range(len(SIDES)))
    notes = (*images.notes, *baseline_notes, *shown, *mounting_notes(rig), *unmasked)
    return RigResult(rig, found, images, notes, drives, angles)


def _find_views(images: PairedImages, board: AnyBoard, progress: Progress) -> list[PairView]:
    """Find the board in the images of both cameras; of a log's many pairs the most diverse ones are selected."""
    of_log = bool(images.topics[0])
    found = list[dict[str, BoardView]]()
    for name, side in zip(SIDES, images.sides, strict=True):
        try:
            views = find_boards(side, board, thorough=not of_log, progress=progress)
        except OmnidError as error:
            raise OmnidError(f"{name} camera: {error}") from error
        found.append({view.name: view for view in views})
    both = [found[0][name] for name in images.names if name in found[0] and name in found[1]]
    selected = set(images.names)
    if of_log and both:
        selected = {view.name for view in select_diverse_views(both)}
    seen = [PairView(name, (found[0].get(name), found[1].get(name))) for name in images.names if name in selected]
    return [view for view in seen if any(view.seen)]


def _by_camera(images: PairedImages, views: Sequence[PairView]) -> list[tuple[Iterable[Image], list[BoardView]]]:
    """Return the images of each camera, and its views of the board."""
    return [
        (own.values(), [seen for view in views if (seen := view.seen[side]) is not None])
        for side, own in enumerate(images.sides)
    ]


def _fit(
    views: list[PairView],
    images: PairedImages,
    board: AnyBoard,
    chosen: tuple[ModelChoice, View],
    progress: Progress,
) -> RigCalibration:
    """Fit each camera, then both cameras with the transform between them."""
    # 1. Fit the rig to a board as drawn.
    found, rejected = _fit_board(views, images, board, AS_DRAWN, chosen, progress)
    # 2. Refine the corners with the cameras, and fit the rig again.
    progress("rig: refining the corners")
    found = refine_rig_calibration(found, images.sides)
    rejected += found.rejected
    # 3. If the print differs from its drawing, fit the cameras and the rig again with its shape.
    shape = rig_print_shape(found)
    if not shape.is_as_drawn:
        progress("the board is not as drawn: once more with its shape")
        found, again = _fit_board(list(found.views), images, board, shape, chosen, progress)
        rejected += [*again, *found.rejected]
    return replace(found, rejected=tuple(rejected))


def _fit_board(
    views: list[PairView],
    images: PairedImages,
    board: AnyBoard,
    shape: PrintShape,
    chosen: tuple[ModelChoice, View],
    progress: Progress,
) -> tuple[RigCalibration, list[RejectedView]]:
    """Fit each camera to its own views of a board of that shape, then the rig to the views that fit their cameras.

    Return the views that do not fit one camera as well. Where the print is taken to be as drawn, which is the first
    time, the corners are refined with each camera.
    """
    model, direction = chosen
    cameras, rejected = list[SelectedCalibration](), list[RejectedView]()
    for side, name in enumerate(SIDES):
        # 1. Fit the models to the camera's views, and select one.
        seen = [own for view in views if (own := view.seen[side]) is not None]
        height, width = images.sides[side][seen[0].name].shape if seen else (0, 0)
        progress(f"{name} camera: fitting {len(seen)} views")
        selected = select_calibration(seen, board, (width, height), model, direction, shape)
        for camera_score in selected.scores:
            word = "selected" if camera_score.model == selected.model else "compared"
            progress(f"{name} camera: {word} {camera_score}")
        if shape.is_as_drawn:
            selected = refine_selection(selected, images.sides[side], direction)
        cameras.append(selected)
        # 2. Leave out this camera's views that do not fit it; the other camera's stay.
        bad = selected.calibration.rejected
        rejected += [RejectedView(view.name, f"{name} camera: {view.reason}") for view in bad]
        views = _without(views, side, {view.name for view in bad})
    # 3. Fit the transform between the cameras, and the cameras with it.
    progress(f"rig: fitting {sum(None not in view.seen for view in views)} pairs")
    lower, upper = (camera.calibration.camera for camera in cameras)
    polynomials = _polynomials(cameras) if model == "auto" else None
    selection = select_rig(views, board, (lower, upper), polynomials, shape)
    for number, score in enumerate(selection.scores):
        progress(f"rig: {'compared' if number else 'selected'} {score}")
    return selection.calibration, rejected


def _polynomials(cameras: Sequence[SelectedCalibration]) -> tuple[OcamCamera, OcamCamera] | None:
    """Return the polynomial cameras from which the terms of real mirrors are fitted; None unless both have one."""
    lower, upper = (camera.polynomial for camera in cameras)
    return None if lower is None or upper is None else (lower, upper)


def _without(views: list[PairView], side: int, names: set[str]) -> list[PairView]:
    """Remove one camera's views of the named instants; the other camera's views are kept."""
    kept = [
        view
        if view.name not in names
        else replace(view, seen=(None, view.seen[1]) if side == 0 else (view.seen[0], None))
        for view in views
    ]
    return [view for view in kept if any(view.seen)]


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


def _masked_rig(found: RigCalibration, images: PairedImages, *, with_struts: bool) -> tuple[Rig, list[str]]:
    """Return the rig with its masks, and warnings about mirrors without a rim in the images."""
    rig = rig_between(found.lower, found.upper, se3.inverse(found.T_upper_lower), images.topics)
    warnings, mounted = list[str](), []
    for name, camera, side in zip(SIDES, (rig.lower, rig.upper), images.sides, strict=True):
        mask = _mask(camera.camera.center, side, with_struts=with_struts)
        mounted.append(replace(camera, mask=mask))
        if mask is None and not sees_directly(camera.camera):
            warnings.append(
                f"no rim of a mirror was found in the {name} camera's images: the daemon searches for it at start, or "
                f"add [{name}.mask] by hand"
            )
    return replace(rig, lower=mounted[0], upper=mounted[1]), warnings


def _mask(center: tuple[float, float], images: Images, *, with_struts: bool) -> Mask | None:
    """Return the mask with hub and struts, or the rim in the maximum of all images."""
    if with_struts:
        return find_mask(list(images.values()), center)
    return find_rim(brightest(images.values()), center)


# Relative error of a drive's length. Up to GOOD_PART there is no warning. From MISFIT_PART on the warning advises
# against the rig: that is a third of the error of wheels, about a per cent, which the cameras are to improve on.
MISFIT_PART, GOOD_PART = 0.003, 0.001


def accuracy_warnings(
    structures: Sequence[ResidualStructure], drives: DriveUncertainty | None, missing: str
) -> list[str]:
    """Return the warnings, none for a rig that is accurate enough.

    A camera whose residuals are more than noise has a line; where both have noise only, one line asks for more pairs.
    structures: those of the residuals of the lower and the upper camera. drives: the error of drives that follows from
    the rig's covariance; None: it is not known. missing: which pairs to add.
    """
    misfits = [
        f"{name} camera: the camera model does not describe this camera: {structure}"
        for name, structure in zip(SIDES, structures, strict=True)
        if structure.is_misfit
    ]
    if drives is None:
        return [f"{line}; do not use it where accuracy matters" for line in misfits]
    if drives.length_part <= GOOD_PART:
        return []
    cost = (
        f"drives may be wrong by {100 * drives.length_part:.2g} % of their length and by {drives.heading_deg_m:.2g} "
        "degree of heading per metre"
    )
    advice = ": do not use it where that matters" if drives.length_part >= MISFIT_PART else ""
    lines = [f"{line}; {cost}{advice}" for line in misfits]
    return lines or [f"the images leave something open: {cost}{missing and '; '}{missing}"]
