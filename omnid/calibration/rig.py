"""Calibration of a rig by a board that both cameras see at once: `omnid.calibrate_rig`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from calib import se3
from calib.boards.board import AnyBoard, AprilGrid, Board
from calib.fit.boards.rig_fit import PairView, RigCalibration, calibrate_boards, rig_covariance
from calib.fit.rig_uncertainty import drive_uncertainty
from calib.models.names import sees_directly
from calib.models.ocam import View
from calib.rig import SIDES, Rig, mounting_notes, rig_between
from calib.rig_file import write_rig
from calib.rim import find_rim
from calib.validation import LineReporter, silent
from drivers.logs.log_reader import AnyCameras, LogCameras
from omnid.calibration.board_search import find_boards, require_one_orientation, view_of_tags
from omnid.calibration.images import PairedImages, brightest, read_pairs
from omnid.calibration.rig_report import angle_lines, angle_rows, rig_report_html
from omnid.errors import OmnidError
from omnid.formats.exports import write_whole

# Relative difference from the baseline by ruler that is no error of a ruler.
REFUSED_PART = 0.1


@dataclass(frozen=True, slots=True)
class RigResult:
    """A calibrated rig with its masks and covariance, and the images that it was fitted to."""

    rig: Rig
    calibration: RigCalibration
    images: PairedImages
    warnings: tuple[str, ...]  # about images that were left out, order of the cameras, and masks that are missing

    def __str__(self) -> str:
        # Errors of drives by the covariance: None if the cameras see too little in common.
        found, drives = self.calibration, drive_uncertainty(self.rig)
        rotation_deg = np.rad2deg(np.linalg.norm(se3.rotation_log(se3.R_of(found.T_upper_lower))))
        sigma_deg = np.rad2deg(np.sqrt(np.diag(found.motion_covariance)[3:].sum()))
        single_views = len(found.views) - found.pairs
        return (
            f"baseline {found.baseline_m * 1e3:.2f} mm (sigma "
            f"{found.baseline_sigma_m * 1e3:.2f}), upper rotated by {rotation_deg:.3f} deg (sigma {sigma_deg:.3f}),"
            f" mean reprojection error {found.fit.mean_px:.3f} px, {found.pairs} pairs"
            + (f", {single_views} views of one camera alone" if single_views else "")
            + (f"; drives: {drives}" if drives else "")
        )

    @property
    def tables(self) -> list[str]:
        """Return the shape of the print, and the tables of residuals by the angle from the axis, in lines."""
        found = self.calibration
        angles = [line for side in range(len(SIDES)) for line in angle_lines(SIDES[side], angle_rows(found, side))]
        return [found.fit.rig.shape.described(found.board.points), *angles]

    def save(self, path: str | PathLike[str]) -> None:
        """Write the rig.toml."""
        write_rig(Path(path), self.rig)

    def save_report(self, path: str | PathLike[str]) -> None:
        """Write an HTML page with residuals and coverage. Raises OmnidError if that is impossible."""
        write_whole(Path(path), rig_report_html(self.calibration, self.images).encode())


def calibrate_rig(
    source: str | PathLike[str],
    board: AnyBoard,
    *,
    topics: AnyCameras = (None, None),
    view: View | None = None,
    expected_baseline_m: float | None = None,
    progress: LineReporter = silent,
) -> RigResult:
    """Calibrate two cameras and the transform between them by images of a board.

    source: a log of both cameras with the topics of the lower and the upper one, or a folder with images lower_*,
    upper_*. view: the world is seen in a mirror or directly; None: as the tags of an AprilTag grid show.
    expected_baseline_m: by ruler; a result that differs by a tenth is refused. progress receives one line for each
    image and each fit. Raises OmnidError or CalibError where the images do not suffice.
    """
    # 1. Read the images, each once.
    require_one_orientation(board)
    if view is None and isinstance(board, Board):
        raise OmnidError(
            "calibrate: a checkerboard looks the same in a mirror and through a lens: add --view mirror or direct"
        )
    images = read_pairs(Path(source), LogCameras(*topics))
    for line in images.notes:
        progress(line)
    # 2. Find the board in all of them.
    views = _find_views(images, board, progress)
    # 3. The view of the cameras, that of a mirror or of a lens, by tags.
    if isinstance(board, AprilGrid):
        view = view_of_tags(view, [seen for pair in views for seen in pair.seen if seen is not None], board)
    # 4. Fit the cameras, and the transform between them.
    sizes = [next(iter(side.values())).shape[::-1] for side in images.sides]
    found = calibrate_boards(views, board, [(w, h) for w, h in sizes], view or "mirror", images.sides, progress)
    # 5. Compare the baseline with what it can be.
    if expected_baseline_m is not None and abs(found.baseline_m / expected_baseline_m - 1) > REFUSED_PART:
        length_mm = 1e3 * board.square_m
        raise OmnidError(
            f"calibrate rig: expected a baseline of {1e3 * expected_baseline_m:g} mm, found "
            f"{1e3 * found.baseline_m:.1f} mm; squares or tags of "
            f"{length_mm * expected_baseline_m / found.baseline_m:.2f} mm would explain it: measure the "
            f"board ({length_mm:g} mm are given) and the distance of the mirrors"
        )
    # 6. Build the rig with masks and covariance.
    rig, unmasked = _masked_rig(found, images)
    rig = replace(rig, covariance=rig_covariance(found, rig))
    left_out = [f"left out {bad.name}: {bad.reason}" for bad in found.rejected]
    return RigResult(rig, found, images, (*images.notes, *mounting_notes(rig), *unmasked, *left_out))


def _find_views(images: PairedImages, board: AnyBoard, progress: LineReporter) -> list[PairView]:
    """Find the board in the images of both cameras."""
    found = [find_boards(name, side, board, progress) for name, side in zip(SIDES, images.sides, strict=True)]
    seen = [PairView(name, (found[0].get(name), found[1].get(name))) for name in images.names]
    return [view for view in seen if view.is_seen]


def _masked_rig(found: RigCalibration, images: PairedImages) -> tuple[Rig, list[str]]:
    """Return the rig with the rims of its mirrors as masks, and warnings about mirrors without a rim in the images."""
    rig = rig_between(found.cameras[0], found.cameras[1], se3.inverse(found.T_upper_lower), images.topics)
    warnings, mounted = list[str](), []
    for (name, camera), side in zip(rig.sides, images.sides, strict=True):
        mask = find_rim(brightest(side.values()), camera.camera.center)
        mounted.append(replace(camera, mask=mask))
        if mask is None and not sees_directly(camera.camera):
            warnings.append(
                f"no rim of a mirror was found in the {name} camera's images: find it in a log by `omnid calibrate "
                f"drive LOG --only mask`, or add [{name}.mask] by hand"
            )
    return replace(rig, lower=mounted[0], upper=mounted[1]), warnings
