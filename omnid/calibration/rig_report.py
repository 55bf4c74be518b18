"""The report of a rig's calibration: one self-contained HTML file with a figure of each camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.fit.boards.rig_fit import RigCalibration
from calib.models.camera import Array, OmniCamera, inside_image
from calib.rig import Rig
from omnid.calibration.images import SIDES, PairedImages
from omnid.calibration.live_boards import HOURS, hours_of
from omnid.calibration.snapshot import GREEN, RED
from omnid.report.page import figure, page, table

# Factor by which residuals are drawn longer.
ARROW = 40.0
WIDTH_PX = 1400  # of two cameras side by side


def rig_report_html(found: RigCalibration, images: PairedImages, angles: Sequence[Sequence[AngleRow]]) -> str:
    """Return the page; angles: the tables of the lower and the upper camera."""
    left_out = "".join(
        f"<p class='warn'>left out {escape(bad.name)}: {escape(bad.reason)}</p>" for bad in found.rejected
    )
    parts = [
        f"<h1>Rig calibration</h1><p>{found.pairs} pairs, {len(found.views) - found.pairs} views of one camera. "
        f"<b>Baseline {found.baseline_m * 1e3:.2f} mm</b>, standard deviation {found.baseline_sigma_m * 1e3:.2f} "
        f"mm. Mean reprojection error {found.fit.mean_px:.3f} px.</p>{left_out}",
    ]
    for name, by_angle in zip(SIDES, angles, strict=True):
        parts += [f"<h2>The {name} camera</h2>", table(HEAD, [row.cells() for row in by_angle])]
    coverage = "".join(_coverage(found, images, side) for side in range(len(SIDES)))
    return page("Rig calibration", [*parts, "<h2>Coverage</h2>", f"<div class='tiles wide'>{coverage}</div>"])


def _coverage(found: RigCalibration, images: PairedImages, side: int) -> str:
    """Return the figure of one camera: all corners and their residuals on one of its images."""
    camera = found.cameras[side]
    views = [(k, view.name, seen) for k, view in enumerate(found.views) if (seen := view.seen[side]) is not None]
    image = images.sides[side][views[0][1]]
    scale = WIDTH_PX / 2 / image.shape[1]
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    canvas = cv2.cvtColor(small // 2, cv2.COLOR_GRAY2BGR)
    for k, _, seen in views:
        starts, arrows = (seen.pixels + 0.5) * scale - 0.5, ARROW * scale * found.fit.residuals[k, side]
        known = np.isfinite(starts + arrows).all(axis=1)
        for start, end in np.rint([starts[known], (starts + arrows)[known]]).astype(int).swapaxes(0, 1).tolist():
            cv2.circle(canvas, start, 3, GREEN, 1, cv2.LINE_AA)
            cv2.line(canvas, start, end, RED, 1, cv2.LINE_AA)
    middle = tuple(round(value * scale) for value in camera.center)
    cv2.drawMarker(canvas, middle, GREEN, cv2.MARKER_CROSS)
    text = f"all corners; arrows are the residuals, {ARROW:.0f} times as long; the cross is the centre"
    return figure(np.asarray(canvas, np.uint8), f"{SIDES[side]}: {text}")


BIN_DEG: Final = 10
IMAGE_STEP_PX: Final = 4  # Between the pixels by which the parts of an image are told.


@dataclass(frozen=True, slots=True)
class AngleRow:
    """One bin of angles from the axis, [low_deg, low_deg + BIN_DEG)."""

    low_deg: int
    corners: int
    rms_px: float  # per coordinate; NaN without corners
    uncovered: tuple[int, ...]  # o'clock, 1 to 12, that the camera sees and no corner lay in
    visible: int  # number of hours that the camera sees

    def cells(self) -> tuple[str, str, str, str]:
        """Return the texts of a table's row."""
        if not self.uncovered:
            missing = ""
        elif len(self.uncovered) == self.visible:
            missing = "anywhere"
        else:
            missing = f"{', '.join(map(str, self.uncovered))} o'clock"
        rms = f"{self.rms_px:.3f}" if self.corners else ""
        return f"{self.low_deg} to {self.low_deg + BIN_DEG} deg", str(self.corners), rms, missing


HEAD: Final = ("angle from the axis", "corners", "rms [px]", "no board")


def angle_rows(found: RigCalibration, rig: Rig, side: int) -> list[AngleRow]:
    """Return the bins of the lower (0) or upper (1) camera, as far as it sees or has corners."""
    mounted = (rig.lower, rig.upper)[side]
    camera = mounted.camera
    # 1. The bins and hours of the corners, and their residuals.
    views = [(k, seen.pixels) for k, view in enumerate(found.views) if (seen := view.seen[side]) is not None]
    pixels = np.concatenate([seen for _, seen in views])
    residuals = np.concatenate([found.fit.residuals[k, side] for k, _ in views])
    known = np.isfinite(pixels).all(axis=1) & np.isfinite(residuals).all(axis=1)
    bins, hours = _places(camera, pixels[known])
    squares = (residuals[known] ** 2).mean(axis=1)
    # 2. Those of the image.
    u, v = (np.arange(0, side, IMAGE_STEP_PX) for side in camera.size)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2).astype(float)
    image_bins, image_hours = _places(camera, grid[inside_image(camera, grid) & mounted.visible.contains(grid)])
    # 3. One row each.
    rows = []
    for number in range(int(max(bins.max(initial=0), image_bins.max(initial=0))) + 1):
        visible = np.unique(image_hours[image_bins == number])
        missing = visible[~np.isin(visible, hours[bins == number])]
        inside = bins == number
        rms_px = math.sqrt(float(squares[inside].mean())) if inside.any() else math.nan
        uncovered = tuple(sorted(int(hour) or HOURS for hour in missing))
        rows.append(AngleRow(BIN_DEG * number, int(inside.sum()), rms_px, uncovered, len(visible)))
    return rows


def angle_lines(name: str, rows: Sequence[AngleRow]) -> list[str]:
    """Return the table of a camera for a terminal."""
    lines = [f"{name} camera: residuals by the angle from its axis"]
    cells = [HEAD, *(row.cells() for row in rows)]
    return lines + [f"  {a:<19} {b:>7} {c:>8}  {d}".rstrip() for a, b, c, d in cells]


def _places(camera: OmniCamera, pixels: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the bins of angles and the hours (N,) of pixels (N, 2); -1 for those without a ray."""
    rays, axis = camera.lift(pixels), camera.lift(np.array([camera.center]))[0]
    angle_deg = np.rad2deg(np.arctan2(np.linalg.norm(np.cross(rays, axis), axis=1), rays @ axis))
    known = np.isfinite(angle_deg)
    bins = np.where(known, np.nan_to_num(angle_deg) // BIN_DEG, -1).astype(np.int64)
    return bins, np.where(known, hours_of(pixels - camera.center), -1)
