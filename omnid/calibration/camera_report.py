"""The report of a camera's calibration: one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from calib.fit.boards.camera_fit import CameraCalibration
from calib.models.camera import Mask
from calib.models.names import model_in_words
from omnid.calibration.figures import (
    ARROW,
    Image,
    coverage_image,
    error_by_radius,
    panorama_image,
    residual_image,
)
from omnid.report.page import bar, figure, page, table, tiles

MAX_VIEWS, SHOWN_VIEWS = 40, 8


def camera_report_html(
    found: CameraCalibration, images: Mapping[str, Image], missing: Sequence[str], mask: Mask | None
) -> str:
    """Return the page; images by the views' names, missing: names of images without a board."""
    first = images[found.views[0].name]
    pixels = np.array([view.pixels for view in found.views])
    views = [(view.pixels, residuals) for view, residuals in zip(found.views, found.fit.residuals, strict=True)]
    parts = [
        _head(found),
        _warnings(found),
        "<h2>Parameters</h2>",
        _parameters(found),
        "<h2>Error by image</h2>",
        _views(found, missing),
        "<h2>Error by distance from the centre</h2>",
        table(
            ("radius [px]", "mean error [px]", "corners"),
            [(f"{r:.0f}", f"{e:.3f}", str(n)) for r, e, n in error_by_radius(found.fit, pixels, found.camera.center)],
        ),
        "<h2>Coverage</h2>",
        figure(
            coverage_image(first, views, found.camera.center),
            f"all corners; arrows are the residuals, {ARROW:.0f} times as long; the cross is the centre",
        ),
        "<h2>Unrolled</h2>",
        figure(
            panorama_image(first, found.camera, mask),
            f"{found.views[0].name} about the ray of the centre: what runs along it in the world stands upright",
        ),
        "<h2>Residuals</h2>",
        tiles(_residuals(found, images), SHOWN_VIEWS),
    ]
    return page("Camera calibration", parts)


def _head(found: CameraCalibration) -> str:
    camera, board = found.camera, found.board
    used = int(np.isfinite(found.fit.errors_px).sum())
    return (
        f"<h1>Camera calibration</h1><p>Model {model_in_words(camera)}, {camera.size[0]}x{camera.size[1]} px. "
        f"{escape(f'{board}')}, {board.square_m * 1e3:g} mm. "
        f"{len(found.views)} views, {used} corners. <b>Mean reprojection error {found.fit.mean_px:.3f} px</b>.</p>"
    )


def _warnings(found: CameraCalibration) -> str:
    lines = [*found.warnings, *(f"left out {bad.name}: {bad.reason}" for bad in found.rejected)]
    return "".join(f"<p class='warn'>{escape(line)}</p>" for line in lines)


def _parameters(found: CameraCalibration) -> str:
    return table(
        ("parameter", "value", "standard deviation"),
        [(name, f"{value:.8g}", f"{sigma:.2g}") for name, value, sigma in found.parameters],
    )


def _views(found: CameraCalibration, missing: Sequence[str]) -> str:
    errors = found.view_errors_px
    worst = float(errors.max())
    corners = [int(np.isfinite(view.pixels[:, 0]).sum()) for view in found.views]
    rows = [
        (escape(view.name), f"{error:.3f}", str(count), f"{view.confidence:.2f}", bar(error / worst))
        for view, error, count in zip(found.views, errors, corners, strict=True)
    ]
    none = f"<p>No board found in {escape(', '.join(missing))}.</p>" if missing else ""
    return table(("image", "mean error [px]", "corners", "confidence", ""), rows) + none


def _residuals(found: CameraCalibration, images: Mapping[str, Image]) -> list[str]:
    shown = list(zip(found.views, found.fit.residuals, found.view_errors_px, strict=True))[:MAX_VIEWS]
    return [
        figure(
            residual_image(images[view.name], view.pixels, residuals),
            f"{view.name}: {error:.3f} px, arrows {ARROW:.0f} times as long",
        )
        for view, residuals, error in sorted(shown, key=lambda entry: -entry[2])
    ]
