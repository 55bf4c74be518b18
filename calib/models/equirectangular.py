"""Equirectangular images, as cameras of 360 degrees stitch them: columns are azimuths, rows are elevations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array
from calib.models.lens import check_plane

# Columns by which a full turn may differ from the image's width, so that the two ends of the image still meet.
SEAM_PX = 1e-3


@dataclass(frozen=True, slots=True)
class EquirectangularCamera:
    """Columns and rows of a radian (fu, fv) [px], and the pixel (pu, pv) of the horizon straight ahead.

    In the camera frame x is to the right, y down, z ahead: u = pu + fu atan2(x, z), v = pv + fv atan2(y, hypot(x, z)).
    A stitched image of a full turn has fu = width / (2 pi); rows may be cut off at its top and its bottom.
    """

    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]

    def __post_init__(self) -> None:
        check_plane("equirectangular", (), self.focal, self.center, self.size)
        if self.size[0] > 2 * math.pi * self.focal[0] + SEAM_PX:
            raise CalibError(
                f"equirectangular camera: {self.size[0]} columns are more than a full turn of "
                f"{2 * math.pi * self.focal[0]:.1f}"
            )

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3); NaN for the origin and for what is not finite.

        Between the middles of the last and of the first column of a full turn, the nearer one is taken.
        """
        x, y, z = np.asarray(points, float).T
        azimuth, elevation = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
        azimuth = np.where(((x == 0) & (y == 0) & (z == 0)) | ~np.isfinite(x + y + z), np.nan, azimuth)
        turn_px = 2 * math.pi * self.focal[0]
        u = self.center[0] + self.focal[0] * azimuth
        middle = (self.size[0] - 1) / 2
        u = middle + (u - middle + turn_px / 2) % turn_px - turn_px / 2
        if abs(turn_px - self.size[0]) <= SEAM_PX:
            u = np.clip(u, 0.0, self.size[0] - 1.0)
        return np.column_stack([u, self.center[1] + self.focal[1] * elevation])

    def lift(self, pixels: Array) -> Array:
        """Return unit rays (N, 3) of pixels (N, 2); NaN above the zenith and below the nadir."""
        azimuth, elevation = ((np.asarray(pixels, float) - self.center) / self.focal).T
        elevation = np.where(np.abs(elevation) <= math.pi / 2, elevation, np.nan)
        level = np.cos(elevation)
        return np.column_stack([level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)])


def full_turn(size: tuple[int, int], top_px: int = 0) -> EquirectangularCamera:
    """Return the camera of stitched images of a full turn, without the first top_px rows of those of half the width."""
    per_rad = size[0] / (2 * math.pi)
    return EquirectangularCamera((per_rad, per_rad), ((size[0] - 1) / 2, (size[0] / 2 - 1) / 2 - top_px), size)
