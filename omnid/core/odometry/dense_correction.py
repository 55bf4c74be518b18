"""Correction of dense disparities for the motion of the rig during the exposures of a frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import at_scale
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.stereo.semiglobal import ColumnShift

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# Spacing, at scale 1, of the points at which the correction is computed exactly. The fields follow the azimuth and the
# row smoothly, so that interpolation over 16 px, 5 degrees of a panorama of 1300 columns, loses little.
GRID_PX = 16
DISPARITIES_PX = (8.0, 40.0)  # At scale 1: disparities at which the correction is exact.


class CorrectedPixels(NamedTuple):
    """Views of N pixels at the stamp, and the variance of their disparities by the uncertainty of the velocity."""

    views: Array  # (N, 3) px: column, lower row, upper row
    variance: Array  # (N,) px^2


@dataclass(frozen=True, slots=True)
class DenseCorrection:
    """Fields (H, W, 2) of a and b of a + b disparity, for disparities as seen between the exposures, px."""

    view: tuple[Floats, Floats, Floats]  # corrections from the pixel and its upper row as seen to the view at the stamp
    column: Floats  # correction from the lower column to that of the upper panorama
    sigma: Floats  # standard deviation of the corrected disparity by the uncertainty of the velocity
    wraps: bool = True  # the panoramas show a full turn

    @staticmethod
    def of(exposure: Exposure, shape: tuple[int, int]) -> DenseCorrection:
        """Return the correction of panoramas (H, W)."""
        scale = exposure.model.cylinder.scale
        grid_px, near = at_scale(GRID_PX, scale), [scale * disparity for disparity in DISPARITIES_PX]
        rows, columns = (grid_px * (np.arange(-(-size // grid_px)) + 0.5) - 0.5 for size in shape)
        grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        found = [_exact(exposure, grid, disparity) for disparity in near]
        slope = (found[1] - found[0]) / (near[1] - near[0])
        both = np.stack([found[0] - slope * near[0], slope], axis=-1)  # (N, 5, 2)
        coarse = np.nan_to_num(both).astype(np.float32).reshape(len(rows), len(columns), 5, 2)
        whole = (len(columns) * grid_px, len(rows) * grid_px)
        fields = [_resized(coarse[:, :, k], whole)[: shape[0], : shape[1]] for k in range(5)]
        return DenseCorrection(
            (fields[0], fields[1], fields[2]),
            fields[3],
            fields[4],
            exposure.model.cylinder.width == exposure.model.cylinder.turn_px,
        )

    def column_shift(self, pad_px: int) -> ColumnShift:
        """Return the shift of the upper column for padded panoramas."""
        mode: Literal["wrap", "edge"] = "wrap" if self.wraps else "edge"
        padded = np.pad(self.column, ((0, 0), (pad_px, pad_px), (0, 0)), mode=mode)
        return ColumnShift(np.ascontiguousarray(padded[:, :, 0]), np.ascontiguousarray(padded[:, :, 1]))

    def corrected(self, columns: Indices, rows: Indices, disparity: Floats) -> CorrectedPixels:
        """Return the views at the stamp of pixels (N,) with disparities (N,) [px] as seen."""
        shifts = np.column_stack([_at(field, columns, rows, disparity) for field in self.view])
        views = np.column_stack([columns, rows, rows + disparity]).astype(float) + shifts
        return CorrectedPixels(views, _at(self.sigma, columns, rows, disparity) ** 2)


def _exact(exposure: Exposure, pixels: Array, disparity: float) -> Array:
    """Return the shifts (N, 3) of the views, of the upper column, and the sigma of the disparity: (N, 5)."""
    rows = pixels[:, 1] + disparity
    views, noise = exposure.corrected(pixels, rows)
    columns, _ = exposure.upper_columns(pixels, rows)
    shifts = views - np.column_stack([pixels, rows])
    variance = noise[:, 1, 1] + noise[:, 2, 2] - 2 * noise[:, 1, 2]
    column_shift = exposure.model.cylinder.wrap(columns - pixels[:, 0])
    return np.column_stack([shifts, column_shift, np.sqrt(np.maximum(variance, 0.0))])


def _resized(field: Floats, size: tuple[int, int]) -> Floats:
    return np.asarray(cv2.resize(np.ascontiguousarray(field), size), np.float32)


def _at(field: Floats, columns: Indices, rows: Indices, disparity: Floats) -> Array:
    a, b = field[rows, columns].T
    return np.asarray(a + b * disparity, float)
