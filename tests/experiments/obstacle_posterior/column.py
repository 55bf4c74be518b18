"""Evidence of one pair, for each direction and range: a surface, the floor, lower than the floor.

An epipolar line is a column, so each direction is a problem of its own. Pixels are compared by the census transform
(Zabih, Woodfill 1994) along the column only, as changes across it tell nothing of the disparity. Differences within the
noise are left out, so that a window without texture fits everywhere alike and is no evidence.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.types.panorama import PaddedPanorama
from tests.experiments.obstacle_posterior import column_kernels as kernels

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Levels = NDArray[np.int16]
Bytes = NDArray[np.uint8]

FINE_PX: Final = 0.8  # sigmas of the band-pass along columns
COARSE_PX: Final = 5.0
TEXTURE_SHARE: Final = 0.3  # of the local contrast by which two views of a surface differ, beside noise
CONTRAST_PX: Final = (3, 15)  # columns and rows in which the contrast is measured
CLEAR: Final = 1.2  # contrast, by noise, from which on a window is evidence
BAND_NOISE: Final = 0.4  # noise of the band-pass, as a share of a panorama's
SIGMA_UNITS: Final = 12.0  # of the normalised images
OUTLIER: Final = np.uint8(48)  # units
UNMATCHED: Final = np.uint8(92)  # cost of a window that nothing explains, in quarters of units
ROW_BOUND: Final = np.int16(60)  # of the evidence of one row
ROW_PRIOR: Final = np.int16(16)  # by which a row of a surface must fit better than its best other explanation
WIDE_M: Final = 1.5  # nearer than this on the floor, mirrors show less detail than the panorama has columns
FLOOR_PX: Final = 1.0  # least difference of disparity by which something is not the floor
BIN_MIDDLE: Final = 0.25  # of a bin: disparities of whole and half rows are compared
REACH_HALF_ROWS: Final = 24  # of the planes about the floor


class FloorPlane(NamedTuple):
    """Floor in the rectified frame: z = -height_m + r (a cos(azimuth) + b sin(azimuth))."""

    height_m: float
    a: float
    b: float


class HeightBand(NamedTuple):
    """Heights over the floor, m."""

    low_m: float  # lower surfaces are floor
    high_m: float  # higher ones are passed below
    edge_m: float  # a floor that is lower by this is an edge


class ColumnEvidence(NamedTuple):
    """Bits by which an explanation is better than the best other one, for K bins and W directions; bin 0 is far."""

    surface: Levels  # (K, W) of the best run of rows
    floor: Levels  # (K, W) sum over the rows in which the floor of that range appears
    below: Levels  # (K, W) the same rows, for anything lower than the floor
    tested: Flags  # (K,) bins whose floor both cameras see
    nearest_floor_m: float  # of these


def floor_plane(T_rect_base: Array, floor_m: float) -> FloorPlane:
    """Return the floor's plane, at a height in the base frame."""
    T = se3.inverse(T_rect_base)
    return FloorPlane(float((T[2, 3] - floor_m) / T[2, 2]), float(-T[2, 0] / T[2, 2]), float(-T[2, 1] / T[2, 2]))


class Columns:
    """Computes the evidence of pairs; tables are computed once for a plane of the floor."""

    def __init__(self, cylinder: Cylinder, baseline_m: float, plane: FloorPlane, band: HeightBand,
                 ranges_m: tuple[float, float]) -> None:
        """ranges_m: nearest and farthest."""
        self._cylinder, self._baseline_m, self._plane, self._band = cylinder, baseline_m, plane, band
        focal, self._floor_slope = cylinder.focal_px, baseline_m / plane.height_m
        self.bins = math.ceil(focal * baseline_m / ranges_m[0])
        self.first_bin = max(1, math.floor(focal * baseline_m / ranges_m[1]))
        self.azimuth_rad = math.pi - (np.arange(cylinder.width) + 0.5) / focal  # in the rectified frame
        self.range_m = focal * baseline_m / (np.arange(self.bins) + 0.5)  # of the middle of each bin
        self._maps = self._warps()
        self._rows: tuple[NDArray[np.int32], NDArray[np.int32]] | None = None

    def evidence(self, lower: PaddedPanorama, upper: PaddedPanorama, visible: Flags) -> ColumnEvidence:
        """Return the evidence of a pair; visible (H, W): pixels that may be compared."""
        if self._rows is None:
            self._rows = self._row_tables(int(np.flatnonzero(visible.mean(axis=1) > 0.5)[-1]))
        # 1. Normalised panoramas; the upper one also half a row lower, and both of these on the plane of the floor.
        noise = BAND_NOISE * max(lower.noise_grey, upper.noise_grey)
        (one, is_clear), (two, _) = _normalised(lower, noise), _normalised(upper, noise)
        warped = [self._warped(two, number) for number in range(4)]
        # 2. Evidence.
        found = [np.zeros((self.bins, self._cylinder.width), np.int16) for _ in range(3)]
        live = np.where(visible & is_clear, np.uint8(255), np.uint8(0))
        kernels.sweep(self._warped(one, 0), np.stack(warped[:2]), np.stack(warped[2:]), live, *self._rows,
                      OUTLIER, UNMATCHED, ROW_BOUND, ROW_PRIOR, *found)
        tested = np.zeros(self.bins, bool)
        tested[np.unique(self._rows[0][:, 2][self._rows[0][:, 2] >= 0])] = True
        nearest = float(self._cylinder.focal_px * self._baseline_m / (np.flatnonzero(tested)[-1] + 1))
        return ColumnEvidence(found[0], found[1], found[2], tested, nearest)

    def _warps(self) -> list[NDArray[np.float32]]:
        """Return the rows (H, W) of a panorama that come to each pixel, with the floor's horizon level: the panorama
        itself, half a row lower, and both on the plane of the floor.
        """
        row0, plane = self._cylinder.row0, self._plane
        tilt = plane.a * np.cos(self.azimuth_rad) + plane.b * np.sin(self.azimuth_rad)
        offset = -self._cylinder.focal_px * tilt
        rows = np.arange(self._cylinder.height)[:, None]
        found = []
        for by in (0.0, 0.5):
            found.append(rows + by + offset)
        for by in (0.0, 0.5):
            found.append(row0 + (1 + self._floor_slope) * (rows + by - row0) + offset)
        return [np.pad(one, ((0, 0), (kernels.PAD, kernels.PAD)), mode="wrap").astype(np.float32) for one in found]

    def _warped(self, image: Bytes, number: int) -> Bytes:
        """Return a padded image (H, W + 2 PAD) at the rows of a warp."""
        columns = np.broadcast_to(np.arange(image.shape[1], dtype=np.float32), self._maps[number].shape)
        return np.asarray(cv2.remap(image, columns, self._maps[number], cv2.INTER_LINEAR,
                                    borderMode=cv2.BORDER_REPLICATE), np.uint8)

    def _row_tables(self, last_row: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return the tables of kernels.sweep."""
        height, focal, band = self._cylinder.height, self._cylinder.focal_px, self._band
        h, row0 = self._plane.height_m, self._cylinder.row0
        rows = np.tile(np.array([0, 0, -1, -1, self.bins, -1, 0, 0], np.int32), (height, 1))
        shifts = np.full((height, 2 * REACH_HALF_ROWS + 1), -1, np.int32)
        steps = np.arange(-REACH_HALF_ROWS, REACH_HALF_ROWS + 1)
        for v in range(kernels.HALF_ROWS, height - kernels.HALF_ROWS):
            end = min(self.bins, last_row - kernels.HALF_ROWS - v)
            rows[v, 1] = max(end, 0)
            fall = v - row0
            if fall <= 0:
                rows[v, 0] = max(self.first_bin, math.ceil(self._baseline_m * -fall / max(band.high_m - h, 1e-3)))
                continue
            floor = self._floor_slope * fall
            lowest = max(floor * h / (h - band.low_m), floor + FLOOR_PX)
            edge = min(floor * h / (h + band.edge_m), floor - FLOOR_PX)
            rows[v, 0] = max(self.first_bin, math.ceil(lowest))
            rows[v, 7] = focal * h / fall < WIDE_M
            rows[v, 2] = floor if self.first_bin <= floor < end else -1
            rows[v, 3], rows[v, 4] = math.floor(edge - 0.5), math.ceil(lowest)
            disparity = floor + (1 + self._floor_slope) * steps / 2
            shifts[v] = np.where(disparity >= 0, np.floor(disparity), -1)
            rows[v, 5] = np.searchsorted(disparity, edge, side="right") - 1
            rows[v, 6] = np.searchsorted(disparity, lowest)
        return rows, shifts


def _normalised(panorama: PaddedPanorama, noise_grey: float) -> tuple[Bytes, Flags]:
    """Return the panorama (H, W + 2 PAD) less its mean along columns, in units of what two views of it differ by, and
    where (H, W) it shows more than noise.
    """
    margin = kernels.PAD + 1
    inner = panorama.image[:, panorama.pad_px - margin : panorama.pad_px + panorama.width + margin].astype(np.float32)
    smooth = cv2.GaussianBlur(inner, (0, 0), sigmaX=FINE_PX, sigmaY=FINE_PX)
    band = smooth - cv2.GaussianBlur(smooth, (1, 2 * round(3 * COARSE_PX) + 1), sigmaX=0.1, sigmaY=COARSE_PX)
    contrast2 = cv2.blur(band * band, CONTRAST_PX)
    unit = np.sqrt(contrast2 * np.float32(TEXTURE_SHARE**2) + np.float32(noise_grey**2))
    found = np.rint(band * (np.float32(SIGMA_UNITS) / unit) + np.float32(128.0))[:, 1:-1]
    is_clear = contrast2[:, margin:-margin] > (CLEAR * noise_grey) ** 2
    return np.ascontiguousarray(np.clip(found, 0, 255), np.uint8), np.asarray(is_clear)
