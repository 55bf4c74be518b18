"""What a pair shows of one plane of the floor, by directions and bins of range.

An epipolar line is a column, so each direction is a problem of its own, whose floor has a disparity that is linear in
the row. Matching compares a pixel with what another view shows there, so panoramas are brought to one working size, in
which no parameter depends on the size of the images, and a pixel is given by how it differs from its column around, by
`sqrt(noise^2 + (share * contrast)^2)`, the standard deviation of the difference of views. For the floor no row around
counts much: no strong edge, such as that of a painted line, hides the weak texture next to it.

Each patch of a column is explained by one disparity. Where there is no texture all of them are as likely, and the
logarithm of the ratio is 0. docs/obstacles.md has them. Bins of range are half a disparity wide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import cv2
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from drivers.jpeg import coding_sigma
from omnid.core.obstacles import evidence_kernels as kernels
from omnid.core.obstacles.ray_kernels import PARAMETERS, THIN_M
from omnid.core.obstacles.settings import ScanSettings
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Tables = NDArray[np.int32]

DIRECTIONS: Final = 480  # columns of the working panorama, 0.75 degrees, because a pole of 3 cm is as wide at 2 m
AZIMUTHS: Final = math.pi - (np.arange(DIRECTIONS) + 0.5) * (math.tau / DIRECTIONS)  # of directions, rectified frame
FOCAL_PX: Final = 139.0  # rows of the working panorama in a radian, because images of 512 px have that resolution
FINE_PX: Final = 0.8  # sigma of the smoothing along columns, because views differ by parts of a row
AROUND_ROWS: Final = 17  # rows with which a pixel is compared
# Difference between two views of a surface, by the local contrast; noise is added to it. Measured: with 0.2 and 0.45
# 8.5 and 15.5 % of the directions of obstacles are called free beyond these instead of 11.1 %.
TEXTURE_SHARE: Final = 0.3
# Noise of a smooth image by that of a panorama: of white noise in images of 512 px 0.54 to 0.66 in the rows of floor,
# of 960 px 0.36 to 0.53. With 0.35, by trial, bases stood before free floor in noisy images.
BAND_NOISE: Final = 0.65
# Frequencies of a JPEG's blocks, of 8, whose errors a working panorama of the image's own resolution shows, because the
# smoothing halves those above. A coarser panorama shows fewer.
CODING_FREQUENCIES: Final = 3.0
# Most that one row around counts, in sigmas of the noise, because the edge of a painted line has a hundred and hid the
# texture of the floor around it. With 3 to 11 bases passed such a line; with no limit they stood before it.
BOUNDED_SIGMAS: Final = 5.5

NEAREST_M: Final = 0.5  # Least range at which surfaces are searched.
# Rows on either side of those in which the floor has a disparity. Measured: with 1, 2 and 3 of them 10.5, 11.1 and 11.8
# % of the directions of obstacles are called free beyond these, and 93.7, 94.9 and 95.8 % of open ones up to 1.5 m.
BIN_ROWS: Final = 2
# Least difference of disparity by which something is not the floor. Measured: 0.87 to 1.95 change nothing.
FLOOR_PX: Final = 1.3
# Lower and higher disparities than the floor's that may explain its rows. Two thirds to 1.5 times change nothing.
OTHERS_PX: Final = (12, 25)
EDGE_M: Final = 0.05  # least fall of the floor that is an edge, because the base's wheels pass lower ones
LEVEL_STEP_PX: Final = 0.375  # between planes below the floor, because matching resolves that
LEVEL_STEPS: Final = 3  # planes on either side, twice as far apart: enough to where others are compared
# Share of the least height and fall by which a floor is uneven, so that two more planes are floor.
EVEN_SHARE: Final = 0.33
HALF_ROWS: Final = 4  # of half a strip of a surface; the other half is the first one of the next strip
LEAST_OTHERS: Final = 1e-4  # bound of the mean likelihood of other explanations
BINS_PER_PX: Final = 2
STEP_ROWS: Final = 4.0  # of a step below its bin, which must be in view


class FloorPlane(NamedTuple):
    """Floor in the rectified frame: z = -height_m + r (a cos(azimuth) + b sin(azimuth))."""

    height_m: float
    a: float
    b: float


class Bins(NamedTuple):
    """The bins of rays, from the nearest whose step is in view to the last that stereo compares."""

    numbers: NDArray[np.intp]  # (N,) half disparities
    ranges_m: Array  # (N,) of their middles
    ends_m: Array  # (N + 1,) at which they begin, and the end of the last


@dataclass(frozen=True, eq=False)
class WorkingPair:
    """A pair in the working size, with the floor's horizon level."""

    lower: Floats  # (H, DIRECTIONS) grey levels
    upper: Floats
    seen: Flags  # (H, DIRECTIONS) pixels that both cameras see, and that are evidence
    floor_row: int  # first row that may show floor
    sensor_grey: float  # noise of the difference of two pixels, by the sensors,
    noise_grey: float  # and of smoothed ones, by sensors and JPEGs

    @cached_property
    def normalised(self) -> tuple[Bytes, Bytes]:
        """By how much both panoramas exceed their columns around, in sigmas of the difference of views.

        Levels are UNITS a sigma about the middle of 8 bits.
        """
        return self._levels(self.lower, 0, math.inf), self._levels(self.upper, 0, math.inf)

    @cached_property
    def bounded(self) -> tuple[Bytes, Bytes]:
        """The same in rows that may show floor, 0 above, where one row around counts BOUNDED_SIGMAS at most."""
        first, most = max(self.floor_row - AROUND_ROWS, 0), BOUNDED_SIGMAS * self.noise_grey
        return self._levels(self.lower, first, most), self._levels(self.upper, first, most)

    def _levels(self, image: Floats, first: int, most: float) -> Bytes:
        smooth = np.asarray(cv2.GaussianBlur(image, (1, 5), sigmaX=0.1, sigmaY=FINE_PX), np.float32)
        band, levels = np.empty_like(smooth[first:]), np.zeros(image.shape, np.uint8)
        kernels.bounded_band_pass(smooth, first, AROUND_ROWS, np.float32(most), band)
        contrast2 = np.asarray(cv2.blur(band * band, (3, AROUND_ROWS)), np.float32)
        noise2, share2 = np.float32(self.noise_grey**2), np.float32(TEXTURE_SHARE**2)
        kernels.in_sigmas(band, contrast2, noise2, share2, levels[first:])
        return levels


class ShownBins(NamedTuple):
    """What a pair shows of the bins (N, DIRECTIONS), from near to far."""

    seen: Flags  # bins in view of both cameras
    # Log-likelihood ratios of the floor, in a direction and those that follow it which something thin hides together,
    floor: Floats
    levels: Floats  # (2, N, DIRECTIONS) of the floor to planes above and below it,
    surface: Floats  # of the best run of rows within the robot's heights,
    fits: Floats  # and of those of them that fit best
    steps: Floats  # of grey across the bins
    greys: Floats
    far: Floats  # (DIRECTIONS,) largest step beyond the last bin,
    near: Floats  # and best surface nearer than the first one


def floor_plane(T_rect_floor: Array) -> FloorPlane:
    """Return the floor's plane z = 0 of a level frame, from which T_rect_floor (4, 4) leads to the rectified one."""
    T = se3.inverse(T_rect_floor)
    return FloorPlane(float(T[2, 3] / T[2, 2]), float(-T[2, 0] / T[2, 2]), float(-T[2, 1] / T[2, 2]))


class PlaneView:
    """Computes what pairs show of a plane; tables are computed once."""

    def __init__(
        self,
        cylinder: Cylinder,
        baseline_m: float,
        plane: FloorPlane,
        settings: ScanSettings,
        visible: Flags,
        bins: Bins | None = None,
    ) -> None:
        """visible (H, W): pixels of a panorama that both cameras see; bins: those of the floor, on whose tilt or ramp
        this plane is, None: it has its own."""
        self.plane, self._baseline_m, self._heights_m = plane, baseline_m, settings.heights_m
        self._floor_slope = baseline_m / plane.height_m
        self.at_1m = FOCAL_PX * baseline_m  # disparity
        self.disparities = math.ceil(self.at_1m / NEAREST_M)
        self._first_disparity = max(1, math.floor(self.at_1m / settings.max_range_m))  # that is compared
        # 1. Working panoramas. A sector has a whole number of directions (calib.panorama.SECTOR_STEPS); in the others
        #    nothing is seen.
        by_column = DIRECTIONS / cylinder.period_px
        self._shown = np.arange(round(by_column * cylinder.width)) + round(by_column * cylinder.first)
        self._shown %= DIRECTIONS
        self._shown_rows = round(cylinder.height * FOCAL_PX / cylinder.focal_px)
        self._coding_frequencies = max(2, round(CODING_FREQUENCIES * FOCAL_PX / cylinder.focal_px))
        self.row0 = (cylinder.row0 + 0.5) * self._shown_rows / cylinder.height - 0.5
        # What rises is seen nearer than level floor: there are so many more rows as it is lifted.
        rise_px = FOCAL_PX * (plane.a * np.cos(AZIMUTHS) + plane.b * np.sin(AZIMUTHS))
        self.height = self._shown_rows + math.ceil(rise_px.max())
        rows = np.arange(self.height)
        self.plane_rows = (rows + self._floor_slope * np.maximum(rows - self.row0, 0.0)).astype(np.float32)
        columns = np.broadcast_to(np.arange(DIRECTIONS, dtype=np.float32), (self.height, DIRECTIONS))
        level_rows = (rows[:, None] - rise_px).astype(np.float32)
        self._level_map = cv2.convertMaps(columns, level_rows, cv2.CV_16SC2) if rise_px.any() else None
        self._visible = self._mask(visible) > 127  # (H, DIRECTIONS)
        # Pixels that the pair before had lost, and those that it had not.
        self._lost, self._seen = np.zeros_like(visible), self._visible
        share = self._visible[:, self._shown].mean(axis=1)
        first_row, self.last_row = _rows_in_use(share > (0.5 if bins is None else 0.0), round(self.row0))
        # 2. Stereo.
        self._patches, self._offsets = self._made_patches()
        self._strips = self._made_strips(first_row)
        # 3. Bins, and the rows of both views that show them.
        if bins is None:
            numbers = np.arange(BINS_PER_PX * self.disparities)
            in_view = self._rows_of(numbers)[1] + STEP_ROWS < self.last_row
            numbers = numbers[in_view & (numbers >= BINS_PER_PX * self._first_disparity)][::-1]
            begins = (numbers + 1) / BINS_PER_PX
            ends_m = self.at_1m / np.append(begins, begins[-1:] - 1 / BINS_PER_PX)
            bins = Bins(numbers, self.at_1m / ((numbers + 0.5) / BINS_PER_PX), ends_m)
        self.bins = bins
        # What lies beyond the bins shows the foot of what ends the floor.
        row_of = self._rows_of(np.concatenate([bins.numbers, np.arange(1, BINS_PER_PX * self._first_disparity)[::-1]]))
        self._row_weights = _row_weights(row_of, self.height)
        row_of = row_of[:, : len(bins.numbers)]
        self._bin_rows = np.clip(np.rint(row_of).astype(int), 0, self.height - 1)
        self._in_view = (row_of[1] + STEP_ROWS < self.last_row)[:, None]

    @property
    def shows_floor(self) -> bool:
        """Whether any floor is in view."""
        return bool(self._of_bins(self._visible).any())

    def pair(self, lower: PaddedPanorama, upper: PaddedPanorama, lost: Flags | None = None) -> WorkingPair:
        """Return a pair in the working size; lost (H, W): pixels that are no evidence, None: all in view are."""
        lost = np.zeros_like(self._lost) if lost is None else lost
        if not np.array_equal(lost, self._lost):  # as in few pairs
            self._lost, self._seen = lost, self._visible & (self._mask(lost) == 0)
        both = lower, upper
        images = [self._sized(np.ascontiguousarray(one.panorama)).astype(np.float32) for one in both]
        if self._level_map is not None:
            at = *self._level_map, cv2.INTER_LINEAR
            remapped = (cv2.remap(image, *at, borderMode=cv2.BORDER_REPLICATE) for image in images)
            images = [np.asarray(image, np.float32) for image in remapped]
        coding_grey = (one.gain * coding_sigma(one.jpeg_steps, self._coding_frequencies) for one in both)
        sensor_grey = math.hypot(lower.noise_grey, upper.noise_grey)
        noise_grey = math.hypot(BAND_NOISE * sensor_grey, *coding_grey)
        floor_row = max(int(self.row0) - BIN_ROWS - 1, 0)
        return WorkingPair(images[0], images[1], self._seen, floor_row, sensor_grey, noise_grey)

    def shown(self, pair: WorkingPair) -> ShownBins:
        """Return what a pair shows of the bins, by its greys and by stereo."""
        # 1. Steps of grey, and greys.
        count, numbers = len(self.bins.numbers), self.bins.numbers
        steps, greys = np.split(self._row_weights @ np.concatenate([pair.lower, pair.upper]), 2)
        far = np.abs(pooled(steps[count:])).max(axis=0, initial=0.0)
        # 2. Surfaces. They fit a little at the next disparities, too.
        live = pair.seen * np.uint8(255)
        surface = np.empty((self.disparities, DIRECTIONS), np.float32)
        lower, upper = pair.normalised
        kernels.surface_evidence(lower, live, *self._bounds(upper), self._strips, surface)
        nearer, farther = (np.roll(surface, shift, axis=0) for shift in (-1, 1))
        surface = np.where((surface >= nearer) & (surface >= farther), surface, np.float32(0))
        # 3. A surface that fits best in the mean of neighbours counts as one; those next to its disparity count half.
        most = np.minimum(surface, PARAMETERS.surface_most)
        three = np.maximum(most, np.maximum(np.roll(most, 1, 0), np.roll(most, -1, 0)) / 2)
        half = int(PARAMETERS.wide_columns) // 2
        wide = cv2.blur(turned(three, half), (2 * half + 1, 1), borderType=cv2.BORDER_REPLICATE)[:, half:-half]
        is_best = wide >= np.maximum(np.roll(wide, 1, 0), np.roll(wide, -1, 0))
        fits = np.where(is_best, np.maximum(most, PARAMETERS.wide_weight * wide), most)
        # 4. The floor, and planes beside it.
        others, levels = np.empty_like(surface), np.empty((2, *surface.shape), np.float32)
        lower, upper = pair.bounded
        bounds, rows = self._bounds(upper), self.plane_rows
        kernels.floor_evidence(lower, upper, live, *bounds, rows, self._patches, self._offsets, others, levels)
        together = self._patches[:, kernels.PATCH_THIN, None].astype(np.float32)
        floor = -together * np.log(np.maximum(others, np.float32(LEAST_OTHERS)))
        # 5. By bins. A surface that fits at a whole disparity is within half of one of it; the next but one is nearer.
        at, of_surface = numbers // BINS_PER_PX, np.minimum((numbers + 1) // BINS_PER_PX, self.disparities - 1)
        stereo = floor[at], levels[:, at], surface[of_surface], fits[of_surface]
        near = most[of_surface[0] + 2 :].max(axis=0, initial=0.0)
        return ShownBins(self._of_bins(pair.seen), *stereo, steps[:count], greys[:count], far, near)

    def _of_bins(self, pixels: Flags) -> Flags:
        """Return bins (N, DIRECTIONS) whose pixels (H, DIRECTIONS) in both views are set."""
        return np.asarray(pixels[self._bin_rows[0]] & pixels[self._bin_rows[1]] & self._in_view)

    def _rows_of(self, numbers: NDArray[np.intp]) -> Array:
        """Return the rows (2, N) of the middles of bins in both views."""
        middle = (numbers + 0.5) / BINS_PER_PX
        lower = self.row0 + 0.5 + middle / self._floor_slope
        return np.stack([lower, lower + middle])

    def _sized(self, image: Bytes) -> Bytes:
        """Return a panorama (H, W) in the working size of a full turn, 0 in directions that it does not show."""
        whole = np.zeros((self._shown_rows, DIRECTIONS), np.uint8)
        size = len(self._shown), self._shown_rows
        whole[:, : len(self._shown)] = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return np.roll(whole, self._shown[0], axis=1)

    def _mask(self, flags: Flags) -> Bytes:
        """Return flags of a panorama (H, W) in the working size, with the plane's horizon level, 255 where set."""
        sized = self._sized(flags * np.uint8(255))
        return sized if self._level_map is None else np.asarray(cv2.remap(sized, *self._level_map, cv2.INTER_LINEAR))

    def _bounds(self, upper: Bytes) -> tuple[Bytes, Bytes]:
        """Return the bounds (2, H, DIRECTIONS) of a normalised panorama, and of what it shows on the plane."""
        own, on_plane = np.empty((2, 2, *upper.shape), np.uint8)
        kernels.half_row_bounds(upper, np.arange(self.height, dtype=np.float32), own)
        kernels.half_row_bounds(upper, self.plane_rows, on_plane)
        return own, on_plane

    def _made_patches(self) -> tuple[Tables, Floats]:
        """Return the tables of patches and of planes of kernels.floor_evidence."""
        h, low_m, last_row = self.plane.height_m, self._heights_m[0], self.height - 2
        patches = np.zeros((self.disparities, 7), np.int32)
        offsets = np.full((4, self.disparities, math.ceil(OTHERS_PX[0] / LEVEL_STEP_PX)), np.nan, np.float32)
        for k in range(self._first_disparity, self.disparities):
            first, end = (math.ceil(self.row0 + n / self._floor_slope) for n in (k, k + 1))
            middle = self._floor_slope * ((first + end - 1) / 2 - self.row0)
            first, end = first - BIN_ROWS, end + BIN_ROWS
            if first < 0 or end + self._floor_slope * (end - self.row0) > self.last_row:
                continue
            # Planes above and just below, to where other disparities are compared, and deeper ones to the lowest
            # disparity: floor that repeats itself, and falls deep at an edge, fits there by another period.
            up, down = (z * (k + 0.5) / (h - z) for z in (low_m, -EDGE_M))
            beside = 2 * LEVEL_STEP_PX * np.arange(LEVEL_STEPS)
            deep = down - LEVEL_STEP_PX * np.arange(offsets.shape[2])
            deep = deep[(deep <= -FLOOR_PX - 1) & (deep > -min(OTHERS_PX[0], k))]
            near = [one[(np.abs(one) < FLOOR_PX + 1) | (beside == 0)] for one in (up + beside, down - beside)]
            planes = np.array([0.0, EVEN_SHARE * up, EVEN_SHARE * down]), *near, deep
            rows = self.plane_rows[[first, end - 1]]
            kept = [one[(rows[0] + one >= 0) & (rows[1] + one <= last_row)] for one in planes]
            if len(kept[0]) < len(planes[0]) or not all(map(len, kept[:3])):
                continue
            for kind, one in enumerate(kept):
                offsets[kind, k, : len(one)] = one
            begin, last = max(0, k - OTHERS_PX[0]), min(self.disparities, self.last_row - end, k + OTHERS_PX[1])
            apart = math.floor(middle - FLOOR_PX), math.ceil(middle + FLOOR_PX)
            thin = max(round(THIN_M * (k + 0.5) / self.at_1m * DIRECTIONS / math.tau), 1)
            patches[k] = first, end, begin, *apart, last, thin
        return patches, offsets

    def _made_strips(self, first_row: int) -> Tables:
        """Return the table of kernels.surface_evidence."""
        found = []
        h, (low_m, high_m) = self.plane.height_m, self._heights_m
        for first in range(first_row, self.last_row - 2 * HALF_ROWS, HALF_ROWS):
            end = first + 2 * HALF_ROWS
            last = min(self.disparities, self.last_row - end)
            fall = (first + end - 1) / 2 - self.row0
            if fall <= 0:
                mine = math.ceil(self._baseline_m * -fall / max(high_m - h, 1e-3))
            else:
                floor = self._floor_slope * fall
                mine = math.ceil(max(floor * h / (h - low_m), floor + FLOOR_PX))
            below = max(math.floor(self._floor_slope * (first - self.row0) - FLOOR_PX), 0)
            found.append((first, end, max(self._first_disparity, mine), max(last, 0), fall > 0, below))
        return np.array(found, np.int32).reshape(-1, 6)


def _rows_in_use(shown: Flags, horizon: int) -> tuple[int, int]:
    """Return the first row that is shown, and the last of the first run of such rows below the horizon.

    Floor nearer than a scan that no direction shows, such as the reflection of a lens, is not used: what comes would be
    out of view on its way there, and so would the floor on which a base drives.
    """
    rows = np.flatnonzero(shown)
    below = rows[rows > horizon]
    if not below.size:
        return int(rows[0]), int(rows[-1])
    gaps = np.flatnonzero(np.diff(below) > 1)
    return int(rows[0]), int(below[gaps[0]] if gaps.size else below[-1])


def pooled(steps: Floats) -> Floats:
    """Return steps (N, DIRECTIONS) as the mean of three directions."""
    return np.asarray((np.roll(steps, 1, axis=1) + 2 * steps + np.roll(steps, -1, axis=1)) / 4, np.float32)


def turned(values: Floats, count: int) -> Floats:
    """Return values (N, D) of a turn with so many directions repeated on either side."""
    return np.concatenate([values[:, -count:], values, values[:, :count]], axis=1)


def _row_weights(rows: Array, height: int) -> scipy.sparse.csr_array:
    """Return the weights (2 N, 2 H) of the rows of both views for steps of grey at rows (2, N), then for greys there.

    A step is the difference of the means of 2.6 rows on either side, less the trend of the rows beyond: a shading is no
    edge.
    """
    edges = np.arange(height)

    def mean(first: float, end: float) -> Array:
        low, high = (np.clip(rows[..., None] + at, 0, height - 1) for at in (first, end))
        part = np.clip(np.minimum(high, edges + 1) - np.maximum(low, edges), 0, None)
        return np.hstack(part / np.maximum(part.sum(axis=-1, keepdims=True), 1e-6))

    above, below, before, beyond = mean(-3.6, -1.0), mean(1.0, 3.6), mean(-8.0, -3.6), mean(3.6, 8.0)
    step = above - below - 0.575 * (before - above + below - beyond)
    return scipy.sparse.csr_array((np.vstack([step, mean(-1.1, 1.1)]) / 2).astype(np.float32))
