"""Images for the report: corners with their residuals, what the boards covered, the world unrolled."""

from __future__ import annotations

import math
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.fit.bundle import Adjusted
from calib.fit.camera_fit import Calibration
from calib.models.camera import Array, Mask, OmniCamera, field_of_view, inscribed_mask

Image = NDArray[np.uint8]
ARROW = 40.0  # residuals are drawn so many times as long as they are
MEASURED, RESIDUAL = (80, 200, 0), (0, 60, 255)
FINE = 4  # bits of a fraction of a pixel in OpenCV's drawing
MARGIN_PX = 40
PANORAMA_WIDTH = 1400


def residual_image(image: Image, pixels: Array, residuals: Array, width: int = 640) -> Image:
    """The part of a image around a board, its corners and ARROW times their residuals, so many pixels wide."""
    known = pixels[np.isfinite(pixels[:, 0])]
    low = np.maximum(np.floor(known.min(axis=0)) - MARGIN_PX, 0).astype(int)
    high = np.minimum(np.ceil(known.max(axis=0)) + MARGIN_PX, image.shape[::-1]).astype(int)
    part, scale = image[low[1]:high[1], low[0]:high[0]], width / (high[0] - low[0])
    canvas = _color(cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC))
    _arrows(canvas, (pixels - low + 0.5) * scale - 0.5, residuals * scale)
    return canvas


def coverage_image(image: Image, found: Calibration, width: int = 900) -> Image:
    """All corners of all views over one image, with ARROW times their residuals."""
    scale = width / image.shape[1]
    canvas = _color(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) // 2)
    for view, residuals in zip(found.views, found.fit.residuals, strict=True):
        _arrows(canvas, (view.pixels + 0.5) * scale - 0.5, residuals * scale)
    cv2.drawMarker(canvas, tuple(round(value * scale) for value in found.camera.center), (255, 200, 0),
                   cv2.MARKER_CROSS, 20, 1)
    return canvas


def panorama_image(image: Image, camera: OmniCamera, mask: Mask | None) -> Image:
    """The image unrolled about the ray of its centre: azimuth along, equal angles down, straight where the world is.

    The farthest from the centre's ray is on top.
    """
    near, far = field_of_view(camera, mask or inscribed_mask(camera))
    near = max(near, math.radians(15))
    scale = PANORAMA_WIDTH / (2 * math.pi)
    rows = np.linspace(far, near, max(16, int((far - near) * scale)))
    azimuth = np.arange(PANORAMA_WIDTH) / scale
    axis = camera.lift(np.array([camera.center]))[0]
    side = np.cross(axis, [0.0, 1, 0] if abs(axis[1]) < 0.9 else [1.0, 0, 0])
    side /= np.linalg.norm(side)
    around = np.cos(azimuth)[:, None] * side + np.sin(azimuth)[:, None] * np.cross(axis, side)
    rays = np.cos(rows)[:, None, None] * axis + np.sin(rows)[:, None, None] * around
    maps = np.nan_to_num(camera.project(rays.reshape(-1, 3)), nan=-1).astype(np.float32)
    u, v = (np.ascontiguousarray(part.reshape(rays.shape[:2])) for part in maps.T)
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR), np.uint8)


def error_by_radius(fit: Adjusted, pixels: Array, center: tuple[float, float]) -> list[tuple[float, float, int]]:
    """Radius [px], mean error [px] and number of corners in eight rings of equally many."""
    radius = np.linalg.norm(pixels - center, axis=2).ravel()
    errors = fit.errors_px.ravel()
    order = np.argsort(radius)
    order = order[np.isfinite(errors[order])]
    return [(float(radius[part].mean()), float(errors[part].mean()), len(part))
            for part in np.array_split(order, 8) if len(part)]


def _color(image: NDArray[np.generic]) -> Image:
    return np.asarray(cv2.cvtColor(np.asarray(image, np.uint8), cv2.COLOR_GRAY2BGR), np.uint8)


def _arrows(canvas: Image, places: Array, residuals: Array) -> None:
    for place, residual in zip(places, residuals, strict=True):
        if np.isfinite(place).all() and np.isfinite(residual).all():
            start, end = _fixed(place), _fixed(place + ARROW * residual)
            cv2.circle(canvas, start, 3 << FINE, MEASURED, 1, cv2.LINE_AA, FINE)
            cv2.line(canvas, start, end, RESIDUAL, 1, cv2.LINE_AA, FINE)


def _fixed(place: Iterable[float]) -> tuple[int, int]:
    u, v = (round(float(value) * (1 << FINE)) for value in place)
    return u, v
