"""Images for the reports: corners with their residuals, the coverage by boards, the unrolled image."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.fit.boards.bundle import BundleResult
from calib.models.camera import Array, Mask, OmniCamera, field_of_view
from calib.models.names import visible_part

Image = NDArray[np.uint8]
# Factor by which residuals are drawn longer.
ARROW = 40.0
# Colours (BGR).
MEASURED, RESIDUAL, CENTER = (80, 200, 0), (0, 60, 255), (255, 200, 0)
# Fractional bits of pixels in OpenCV's drawing functions.
FINE = 4
MARGIN_PX = 40
RESIDUAL_PX, COVERAGE_PX = 320, 700  # widths of the figures
CIRCLE_PX, CROSS_PX = 3, 20
PANORAMA_WIDTH, MIN_PANORAMA_HEIGHT = 1400, 16
# The panorama begins this far from the ray of the centre, where a cylinder's scale would be too large.
MIN_PANORAMA_ANGLE_DEG = 15
# Number of rings in the table of errors by radius.
RINGS = 8


def residual_image(image: Image, pixels: Array, residuals: Array) -> Image:
    """Return the square part of an image around a board, RESIDUAL_PX wide, with corners and ARROW times residuals."""
    known = pixels[np.isfinite(pixels[:, 0])]
    edge = int(min(np.ceil(np.ptp(known, axis=0).max()) + 2 * MARGIN_PX, *image.shape))
    middle = (known.min(axis=0) + known.max(axis=0)) / 2
    low = np.clip(np.round(middle - edge / 2).astype(int), 0, np.array(image.shape[::-1]) - edge)
    part, scale = image[low[1] : low[1] + edge, low[0] : low[0] + edge], RESIDUAL_PX / edge
    canvas = _color(cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC))
    _arrows(canvas, (pixels - low + 0.5) * scale - 0.5, residuals * scale)
    return canvas


def coverage_image(image: Image, views: Sequence[tuple[Array, Array]], center: tuple[float, float]) -> Image:
    """Return one image with the corners of all views (pixels, residuals) and ARROW times their residuals."""
    scale = COVERAGE_PX / image.shape[1]
    canvas = _color(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) // 2)
    for pixels, residuals in views:
        _arrows(canvas, (pixels + 0.5) * scale - 0.5, residuals * scale)
    cv2.drawMarker(canvas, tuple(round(value * scale) for value in center), CENTER, cv2.MARKER_CROSS, CROSS_PX, 1)
    return canvas


def panorama_image(image: Image, camera: OmniCamera, mask: Mask | None) -> Image:
    """Unroll the image about the ray of its centre: columns of azimuth, rows of equal angles from that ray.

    The largest angle is on top. Straight lines along the ray of the centre are straight columns.
    """
    near, far = field_of_view(camera, mask or visible_part(camera))
    near = max(near, math.radians(MIN_PANORAMA_ANGLE_DEG))
    scale = PANORAMA_WIDTH / (2 * math.pi)
    rows = np.linspace(far, near, max(MIN_PANORAMA_HEIGHT, int((far - near) * scale)))
    azimuth = np.arange(PANORAMA_WIDTH) / scale
    axis = camera.lift(np.array([camera.center]))[0]
    side = np.cross(axis, [0.0, 1, 0] if abs(axis[1]) < 0.9 else [1.0, 0, 0])
    side /= np.linalg.norm(side)
    around = np.cos(azimuth)[:, None] * side + np.sin(azimuth)[:, None] * np.cross(axis, side)
    rays = np.cos(rows)[:, None, None] * axis + np.sin(rows)[:, None, None] * around
    maps = np.nan_to_num(camera.project(rays.reshape(-1, 3)), nan=-1).astype(np.float32)
    u, v = (np.ascontiguousarray(part.reshape(rays.shape[:2])) for part in maps.T)
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR), np.uint8)


def error_by_radius(fit: BundleResult, pixels: Array, center: tuple[float, float]) -> list[tuple[float, float, int]]:
    """Return radius [px], mean error [px] and number of corners of RINGS rings with equal numbers of corners."""
    radius = np.linalg.norm(pixels - center, axis=2).ravel()
    errors = fit.errors_px.ravel()
    order = np.argsort(radius)
    order = order[np.isfinite(errors[order])]
    return [
        (float(radius[part].mean()), float(errors[part].mean()), len(part))
        for part in np.array_split(order, RINGS)
        if len(part)
    ]


def _color(image: NDArray[np.generic]) -> Image:
    return np.asarray(cv2.cvtColor(np.asarray(image, np.uint8), cv2.COLOR_GRAY2BGR), np.uint8)


def _arrows(canvas: Image, pixels: Array, residuals: Array) -> None:
    for pixel, residual in zip(pixels, residuals, strict=True):
        if np.isfinite(pixel).all() and np.isfinite(residual).all():
            start, end = _fixed_point(pixel), _fixed_point(pixel + ARROW * residual)
            cv2.circle(canvas, start, CIRCLE_PX << FINE, MEASURED, 1, cv2.LINE_AA, FINE)
            cv2.line(canvas, start, end, RESIDUAL, 1, cv2.LINE_AA, FINE)


def _fixed_point(pixel: Iterable[float]) -> tuple[int, int]:
    u, v = (round(float(value) * (1 << FINE)) for value in pixel)
    return u, v
