"""Calibration of one camera by images of a board: `omnid.calibrate_camera`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from calib.camera_file import CameraFile, Quality, camera_toml
from calib.fit.boards.camera_fit import CameraCalibration
from calib.fit.boards.camera_selection import (
    ModelChoice,
    SelectedCalibration,
    camera_structure,
    refine_selection,
    select_calibration,
    with_print_shape,
)
from calib.fit.residual_structure import ResidualStructure
from calib.masks.stack_mask import find_mask
from calib.models.camera import Mask
from calib.png import png
from calib.rig_file import write_file
from omnid.calibration.board_search import AnyBoard, find_boards, select_diverse_views
from omnid.calibration.camera_report import camera_report_html
from omnid.calibration.images import Images, is_log, read_images, repeat_notes, repeats
from omnid.calibration.progress import Progress, silent
from omnid.calibration.view_guess import ViewChoice, view_of_images


@dataclass(frozen=True, slots=True)
class CameraResult:
    """A calibrated camera, with the images that it was fitted to."""

    selected: SelectedCalibration
    mask: Mask | None  # rim, hub and struts, if they were searched
    images: Images
    notes: tuple[str, ...] = ()  # about images that are the same, and the view

    @property
    def calibration(self) -> CameraCalibration:
        """The camera, its parameters with standard deviations, the poses and residuals of all views."""
        return self.selected.calibration

    @property
    def is_misfit(self) -> bool:
        """True if the camera model leaves more than noise."""
        return camera_structure(self.calibration).is_misfit

    @property
    def warnings(self) -> list[str]:
        """Limits of the result, one line each."""
        found = self.calibration
        return [
            *misfit_warning("camera", camera_structure(found)),
            *found.shape.notes(found.board.points),
            *self.notes,
            *found.warnings,
            *(f"left out {bad.name}: {bad.reason}" for bad in found.rejected),
        ]

    def __str__(self) -> str:
        found = self.calibration
        (width, height), (u, v) = found.camera.size, found.camera.center
        corners = int(np.isfinite(found.fit.errors_px).sum())
        return (
            f"{'MISFIT: ' if self.is_misfit else ''}model {self.selected.model}, {width}x{height}, centre {u:.2f} "
            f"{v:.2f}, mean reprojection error {found.fit.mean_px:.3f} px over {corners} corners of "
            f"{len(found.views)} views"
        )

    def save(self, path: Path, mask_path: Path | None = None) -> None:
        """Write the camera.toml, and the mask to a PNG in the same folder, which the camera.toml names."""
        if mask_path is not None and self.mask is not None and self.mask.image is not None:
            write_file(mask_path, png(self.mask.image))
        found = self.calibration
        quality = Quality(found.fit.mean_px, len(found.views), found.parameters)
        file = CameraFile(found.camera, self.mask)
        write_file(path, camera_toml(file, quality, mask_path.name if mask_path else "").encode())

    def save_report(self, path: Path) -> None:
        """Write an HTML page with residuals and coverage."""
        seen = {view.name for view in self.calibration.views} | {bad.name for bad in self.calibration.rejected}
        missing = sorted(set(self.images) - seen)
        write_file(path, camera_report_html(self.calibration, self.images, missing, self.mask).encode())


def calibrate_camera(
    sources: str | PathLike[str] | Sequence[str | PathLike[str]],
    board: AnyBoard,
    *,
    topic: str | None = None,
    model: ModelChoice = "auto",
    view: ViewChoice = "auto",
    with_mask: bool = False,
    progress: Progress = silent,
) -> CameraResult:
    """Calibrate a camera by images of a board that it saw at several places.

    sources: a file, folder or pattern of images, or several; or one log, with the topic of the camera in it. model:
    "auto" fits every model and selects by cross-validation. view: the world is seen in a mirror or directly; "auto": as
    the images show, see `view_guess`. with_mask: also search rim, hub and struts. progress receives one line for each
    image and each model. Raises OmnidError or CalibError where the images do not suffice.
    """
    # 1. Read the images, each once.
    names = [os.fspath(name) for name in ([sources] if isinstance(sources, str | PathLike) else sources)]
    images = read_images(names, topic)
    repeated = repeats([images])
    images = {name: image for name, image in images.items() if name not in repeated}
    for line in (left_out := repeat_notes(repeated)):
        progress(line)
    many = any(is_log(Path(name)) for name in names)
    # 2. Find the board in each. Of a log the views that differ most are used.
    views = find_boards(images, board, thorough=not many, progress=progress)
    views = select_diverse_views(views) if many else views
    seen, shown = view_of_images(view, [(images.values(), views)], board, progress)
    # 3. Fit the models, and select the one with the least error at views that it was not fitted to.
    height, width = images[views[0].name].shape
    selected = select_calibration(views, board, (width, height), model, seen)
    report_scores(selected, "camera", progress)
    # 4. Refine the corners with the camera, and fit it again.
    selected = refine_selection(selected, images, seen)
    # 5. If the print differs from its drawing, select and fit again with its shape.
    bent = with_print_shape(selected, seen)
    if bent is not selected:
        report_scores(bent, "camera, with the shape of the print", progress)
    # 6. Find what never shows the world.
    center = bent.calibration.camera.center
    mask = find_mask(list(images.values()), center) if with_mask else None
    return CameraResult(bent, mask, images, (*left_out, *shown))


def report_scores(selected: SelectedCalibration, name: str, progress: Progress) -> None:
    """Report the score of each model that was fitted to a camera."""
    for score in selected.scores:
        progress(f"{name}: {'selected' if score.model == selected.model else 'compared'} {score}")


def misfit_warning(name: str, structure: ResidualStructure) -> list[str]:
    """Return a warning if the residuals of the camera of that name are more than noise, else none."""
    words = "the camera model does not describe this camera: {}; do not use it where accuracy matters"
    return [f"{name}: {words.format(structure)}"] if structure.is_misfit else []
