"""Images of the cameras as they are, with the mirror's rim and measures of focus and light: for the mounting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from calib.models.camera import Mask
from calib.rim import find_rim
from omnid.calibration.images import Image, brightest, middle_px
from omnid.core.stereo.tiles import SATURATED_GREY

IMAGES: Final = 10  # Images of each camera: the rim is searched in their maximum.
GREEN, RED = (80, 220, 80), (60, 60, 230)


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
    """View of one camera, with its measures."""

    image: Image  # (H, W) the newest
    rim: Mask | None  # None: no rim was found with certainty
    focus: float  # variance of the Laplacian (Pech-Pacheco et al. 2000), as a share of that of the grey levels
    level_grey: float  # mean grey level
    saturated: float  # share of the pixels that are too bright


def view_of(images: Sequence[Image]) -> CameraView:
    """Return the measures of one camera's images (H, W), of one size; at least one."""
    newest = images[-1]
    rim = find_rim(brightest(images), middle_px(newest))
    smooth = cv2.GaussianBlur(newest, (0, 0), 0.8).astype(np.float32)  # the Laplacian sees noise first
    focus = float(cv2.Laplacian(smooth, cv2.CV_32F).var() / max(1.0, newest.var()))
    return CameraView(newest, rim, focus, float(newest.mean()), float((newest >= SATURATED_GREY).mean()))


def described(view: CameraView) -> str:
    """Return the measures in one line."""
    height, width = view.image.shape
    rim = "no rim found"
    if view.rim is not None:
        (u, v), (middle_u, middle_v) = view.rim.center, middle_px(view.image)
        rim = (
            f"rim: centre ({u:.0f}, {v:.0f}) px, {u - middle_u:+.0f} and {v - middle_v:+.0f} px from the middle, "
            f"radius {view.rim.outer_px:.0f} px"
        )
    return (
        f"{width}x{height}, {rim}; focus {1e3 * view.focus:.1f}; brightness {view.level_grey:.0f}, "
        f"{100 * view.saturated:.1f} % too bright"
    )


def annotated(view: CameraView) -> Image:
    """Return the image (H, W, 3) BGR with rim, hub, and the middle of the image."""
    image = cv2.cvtColor(view.image, cv2.COLOR_GRAY2BGR)
    height, width = view.image.shape
    if view.rim is not None:
        center = tuple(round(value) for value in view.rim.center)
        for radius in (view.rim.outer_px, view.rim.inner_px):
            cv2.circle(image, center, round(radius), GREEN, 1, cv2.LINE_AA)
        cv2.drawMarker(image, center, GREEN, cv2.MARKER_CROSS)
    cv2.drawMarker(image, (width // 2, height // 2), RED, cv2.MARKER_TILTED_CROSS)
    return np.asarray(image, np.uint8)
