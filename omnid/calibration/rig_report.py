"""The report of a rig's calibration: one self-contained HTML file."""

from __future__ import annotations

from html import escape

import cv2
import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.fit.boards.rig_fit import MOTION_NAMES, RigCalibration
from calib.panorama import fit_cylinder, remap_tables
from calib.rig import Rig
from omnid.calibration.figures import ARROW, Image, coverage_image, residual_image
from omnid.calibration.image_pairs import SIDES, PairedImages
from omnid.report.page import bar, figure, folded, page, table, tiles

MAX_VIEWS, SHOWN = 20, 8
# Number of columns drawn through both panoramas, and their colour (BGR).
LINES, LINE_COLOR = 24, (80, 200, 0)
PANORAMA_WIDTH = 1400


def rig_report_html(found: RigCalibration, images: PairedImages, rig: Rig) -> str:
    """Return the page."""
    parts = [_head(found), "<h2>Between the cameras</h2>", _motion(found)]
    for name, parameters in zip(SIDES, found.parameters, strict=True):
        rows = [(key, f"{value:.8g}", f"{sigma:.2g}") for key, value, sigma in parameters]
        parts += [
            f"<h2>The {name} camera</h2>",
            folded("parameters", table(("parameter", "value", "standard deviation"), rows))
            if rows
            else "<p>Not changed: the camera was given.</p>",
        ]
    parts += [
        "<h2>Coverage</h2>",
        *_coverage(found, images),
        "<h2>Error by instant</h2>",
        _views(found),
        "<h2>Rectified</h2>",
        *_rectified(found, images, rig),
        "<h2>Residuals</h2>",
        tiles(_residuals(found, images), SHOWN),
    ]
    return page("Rig calibration", parts)


def _head(found: RigCalibration) -> str:
    left_out = "".join(
        f"<p class='warn'>left out {escape(bad.name)}: {escape(bad.reason)}</p>" for bad in found.rejected
    )
    return (
        f"<h1>Rig calibration</h1><p>{found.pairs} pairs, {len(found.views) - found.pairs} views of one camera. "
        f"<b>Baseline {found.baseline_m * 1e3:.2f} mm</b>, standard deviation {found.baseline_sigma_m * 1e3:.2f} "
        f"mm. Mean reprojection error {found.fit.mean_px:.3f} px.</p>{left_out}"
    )


def _motion(found: RigCalibration) -> str:
    """Return the table of T_upper_lower in millimetres and degrees."""
    turn = se3.rotation_log(found.T_upper_lower[:3, :3])
    values = np.concatenate([found.T_upper_lower[:3, 3] * 1e3, np.rad2deg(turn)])
    sigmas = np.concatenate([found.motion_sigma[:3] * 1e3, np.rad2deg(found.motion_sigma[3:])])
    units = ["mm"] * 3 + ["deg"] * 3
    return table(
        ("T_upper_lower", "value", "standard deviation"),
        [
            (name, f"{value:.4f} {unit}", f"{sigma:.4f}")
            for name, value, sigma, unit in zip(MOTION_NAMES, values, sigmas, units, strict=True)
        ],
    )


def _views(found: RigCalibration) -> str:
    lower, upper = (found.side_errors_px(side) for side in (0, 1))
    worst = float(np.nanmax([lower, upper]))
    rows = [
        (escape(view.name), _number(a), _bar(a, worst), _number(b), _bar(b, worst))
        for view, a, b in zip(found.views, lower, upper, strict=True)
    ]
    return table(("instant", "lower [px]", "", "upper [px]", ""), rows)


def _bar(error: float, worst: float) -> str:
    return bar(error / worst if np.isfinite(error) else 0.0)


def _coverage(found: RigCalibration, images: PairedImages) -> list[str]:
    """Return a figure of each camera with all corners on one of its images."""
    figures = []
    for side, (name, camera) in enumerate(zip(SIDES, (found.lower, found.upper), strict=True)):
        views = [
            (seen.pixels, np.split(found.fit.residuals[k], 2)[side])
            for k, view in enumerate(found.views)
            if (seen := view.seen[side]) is not None
        ]
        first = next(view.name for view in found.views if view.seen[side] is not None)
        image = coverage_image(images.sides[side][first], views, camera.center)
        figures.append(
            figure(
                image,
                f"{name}: all corners; arrows are the residuals, {ARROW:.0f} times as long; the cross is the centre",
            )
        )
    return [f"<div class='tiles wide'>{''.join(figures)}</div>"]


def _number(error: float) -> str:
    return f"{error:.3f}" if np.isfinite(error) else "not seen"


def _rectified(found: RigCalibration, images: PairedImages, rig: Rig) -> list[str]:
    """Return the figure of both panoramas of one instant, one above the other, with common columns."""
    name = next(view.name for view in found.views if None not in view.seen)
    try:
        cylinder = fit_cylinder(rig, PANORAMA_WIDTH)
    except CalibError as error:
        return [f"<p class='warn'>{escape(str(error))}</p>"]
    rows = [
        cv2.remap(side[name], *remap_tables(rig, mounted, cylinder), cv2.INTER_LINEAR)
        for side, mounted in zip(reversed(images.sides), (rig.upper, rig.lower), strict=True)
    ]
    canvas = np.asarray(cv2.cvtColor(np.vstack(rows), cv2.COLOR_GRAY2BGR), np.uint8)
    for column in range(PANORAMA_WIDTH // (2 * LINES), PANORAMA_WIDTH, PANORAMA_WIDTH // LINES):
        canvas[:, column] = LINE_COLOR
    return [figure(canvas, f"{name}: the upper panorama above the lower one; a point is in the same column of both")]


def _residuals(found: RigCalibration, images: PairedImages) -> list[str]:
    shown = []
    for k, view in enumerate(found.views[:MAX_VIEWS]):
        for side, seen in enumerate(view.seen):
            if seen is not None:
                image: Image = images.sides[side][view.name]
                residuals = np.split(found.fit.residuals[k], 2)[side]
                shown.append(
                    figure(
                        residual_image(image, seen.pixels, residuals),
                        f"{SIDES[side]}, {view.name}: arrows {ARROW:.0f} times as long",
                    )
                )
    return shown
