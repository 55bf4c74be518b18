"""The report of a rig's calibration: one self-contained HTML file with a figure of each camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Final, TypeAlias

import cv2
import numpy as np

from calib.fit.boards.rig_fit import RigCalibration
from calib.rig import SIDES
from omnid.calibration.images import PairedImages
from omnid.calibration.snapshot import GREEN, RED
from omnid.report.page import figure, page, table

Row: TypeAlias = tuple[str, str, str]  # angle from the axis, corners, rms [px]
RESIDUAL_SCALE: Final = 40  # Factor by which residuals are drawn longer.


def rig_report_html(found: RigCalibration, images: PairedImages) -> str:
    """Return the page."""
    left_out = "".join(
        f"<p class='warn'>left out {escape(bad.name)}: {escape(bad.reason)}</p>" for bad in found.rejected
    )
    parts = [
        f"<h1>Rig calibration</h1><p>{found.pairs} pairs, {len(found.views) - found.pairs} views of one camera. "
        f"<b>Baseline {found.baseline_m * 1e3:.2f} mm</b>, standard deviation {found.baseline_sigma_m * 1e3:.2f} "
        f"mm. Mean reprojection error {found.fit.mean_px:.3f} px.</p>{left_out}",
    ]
    for side, name in enumerate(SIDES):
        parts += [f"<h2>The {name} camera</h2>", table(HEAD, angle_rows(found, side))]
    coverage = "".join(_coverage(found, images, side) for side in range(len(SIDES)))
    return page("Rig calibration", [*parts, "<h2>Coverage</h2>", f"<div class='tiles wide'>{coverage}</div>"])


def _coverage(found: RigCalibration, images: PairedImages, side: int) -> str:
    """Return the figure of one camera: all corners and their residuals on one of its images."""
    camera = found.cameras[side]
    views = [(k, view.name, seen) for k, view in enumerate(found.views) if (seen := view.seen[side]) is not None]
    image = images.sides[side][views[0][1]]
    canvas = cv2.cvtColor(image // 2, cv2.COLOR_GRAY2BGR)
    for k, _, starts in views:
        ends = starts + RESIDUAL_SCALE * found.fit.residuals[k, side]
        known = np.isfinite(ends).all(axis=1)
        for start, end in np.rint([starts[known], ends[known]]).astype(int).swapaxes(0, 1).tolist():
            cv2.circle(canvas, start, 3, GREEN, 1, cv2.LINE_AA)
            cv2.line(canvas, start, end, RED, 1, cv2.LINE_AA)
    middle = tuple(round(value) for value in camera.center)
    cv2.drawMarker(canvas, middle, GREEN, cv2.MARKER_CROSS)
    text = f"all corners; red lines are the residuals, {RESIDUAL_SCALE} times as long; the cross is the centre"
    return figure(np.asarray(canvas, np.uint8), f"{SIDES[side]}: {text}")


BIN_DEG: Final = 10
HEAD: Final = ("angle from the axis", "corners", "rms [px]")


def angle_rows(found: RigCalibration, side: int) -> list[Row]:
    """Return the bins of the lower (0) or upper (1) camera up to the widest angle that a board has covered, as texts.

    The rms is that of a coordinate.
    """
    camera = found.cameras[side]
    seen = [(k, view) for k, pair in enumerate(found.views) if (view := pair.seen[side]) is not None]
    residuals = np.concatenate([found.fit.residuals[k, side] for k, _ in seen])
    rays, axis = camera.lift(np.concatenate([pixels for _, pixels in seen])), camera.lift(np.array([camera.center]))[0]
    angle_deg = np.rad2deg(np.arctan2(np.linalg.norm(np.cross(rays, axis), axis=1), rays @ axis))
    known = np.isfinite(angle_deg) & np.isfinite(residuals).all(axis=1)
    bins, squares = (angle_deg[known] // BIN_DEG).astype(int), (residuals[known] ** 2).mean(axis=1)
    corners, totals = np.bincount(bins), np.bincount(bins, squares)
    return [
        (
            f"{BIN_DEG * number} to {BIN_DEG * (number + 1)} deg",
            str(count),
            f"{math.sqrt(total / count):.3f}" if count else "",
        )
        for number, (count, total) in enumerate(zip(corners.tolist(), totals.tolist(), strict=True))
    ]


def angle_lines(name: str, rows: Sequence[Row]) -> list[str]:
    """Return the table of a camera for a terminal."""
    lines = [f"{name} camera: residuals by the angle from its axis"]
    return lines + [f"  {a:<19} {b:>7} {c:>8}".rstrip() for a, b, c in (HEAD, *rows)]
