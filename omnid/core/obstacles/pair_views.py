"""Panoramas of a pair in one working size, in units of what two views of one place differ by.

Matching compares a pixel with what another view shows there, so an image is given by how it differs from its column
around: of surfaces by a band-pass, and of the floor by one in which no strong edge hides the weak texture next to it.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from drivers.jpeg import coding_sigma
from omnid.core.obstacles import panorama_kernels as kernels
from omnid.core.types.panorama import PaddedPanorama

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Flags = NDArray[np.bool_]

DIRECTIONS: Final = 480  # columns of the working panorama, 0.75 degrees, because a pole of 3 cm is as wide at 2 m
FOCAL_PX: Final = 139.0  # rows of the working panorama in a radian, because images of 512 px have that resolution
FINE_PX: Final = 0.8  # Sigma of the smoothing along columns, because views differ by parts of a row.
# Rows of the coarse mean, which is taken twice, like a Gaussian with a sigma of 7 rows. Measured: with 11
# and 26 rows 12.9 and 13.3 % of the directions of things are called free beyond these instead of 11.1 %.
COARSE_ROWS: Final = 17
# Difference between two views of a surface, by the local contrast; noise is added to it. Measured: with 0.2 and 0.45
# 8.5 and 15.5 % (as above), and 1.3 and 0.3 % of the directions have a false obstacle instead of 0.5 %.
TEXTURE_SHARE: Final = 0.3
# Rows over which the contrast is measured, with a column on either side. Measured: with 10 and 22 12.4
# and 10.6 % (as above).
CONTRAST_ROWS: Final = 15
# Noise of a smooth image by that of a panorama: of white noise in images of 512 px 0.54 to 0.66 in the rows of floor,
# of 960 px 0.36 to 0.53 (test_pair_views.py). With 0.35, by trial, bases stood before free floor in noisy images.
BAND_NOISE: Final = 0.65
# Frequencies of a JPEG's blocks, of 8, whose errors a working panorama of the image's own resolution shows, because the
# smoothing halves those above. A coarser panorama shows fewer.
CODING_FREQUENCIES: Final = 3.0
UNITS: Final = 12.0  # Units of a normalised image in one sigma, because it has 8 bits and ten sigmas either way.
ZERO: Final = 128.5  # Its level without texture, and half a level, because kernels cut what they round.
BOUNDED_ROWS: Final = COARSE_ROWS  # Rows with which a pixel of the floor is compared.
# Most that one of them counts, in sigmas of the noise, because the edge of a painted line has a hundred and hid the
# texture of the floor around it. With 3 to 11 bases passed such a line; with no limit they stood before it.
BOUNDED_SIGMAS: Final = 5.5


class WorkingPair(NamedTuple):
    """A pair in the working size, with the floor's horizon level."""

    lower: Floats  # (H, DIRECTIONS) grey levels
    upper: Floats
    seen: Flags  # (H, DIRECTIONS) pixels that both cameras see, and that are evidence
    sensor_grey: float  # noise of the difference of two pixels, by the sensors,
    noise_grey: float  # and of smoothed ones, by sensors and JPEGs


class Views(NamedTuple):
    """Normalised panoramas (H, DIRECTIONS) of a pair, as the kernels compare them."""

    lower: Bytes
    upper: Bytes
    upright: Bytes  # (2, H, DIRECTIONS) least and most of the upper one within half a row of each pixel
    plane: Bytes  # the same of the upper one on the plane of the floor
    live: Bytes  # 255 where pixels may be compared, else 0


class WorkingPanoramas:
    """Brings panoramas to the working size, with the floor's horizon level."""

    def __init__(self, cylinder: Cylinder, tilt: tuple[float, float], floor_slope: float, visible: Flags) -> None:
        """tilt: slopes of the floor in the rectified frame; floor_slope: change of its disparity from row to row.

        visible (H, W): pixels of a panorama that both cameras see.
        """
        # A sector has a whole number of directions (calib.panorama.SECTOR_STEPS); in the others nothing is seen.
        self.shown = (
            np.arange(DIRECTIONS * cylinder.width // cylinder.turn_px) + DIRECTIONS * cylinder.first // cylinder.turn_px
        ) % DIRECTIONS
        self.height = round(cylinder.height * FOCAL_PX / cylinder.focal_px)
        self.row0 = (cylinder.row0 + 0.5) * self.height / cylinder.height - 0.5
        self._coding_frequencies = max(2, round(CODING_FREQUENCIES * FOCAL_PX / cylinder.focal_px))
        rows = np.arange(self.height)
        self.plane_rows = (rows + floor_slope * np.maximum(rows - self.row0, 0.0)).astype(np.float32)
        self._plane_steps = np.rint(self.plane_rows * kernels.STEPS_PER_ROW).astype(np.int32)
        self._maps = self._made_maps(*tilt) if any(tilt) else None
        self.visible = self._sized(visible * np.uint8(255)) > 127  # (H, DIRECTIONS)

    def pair(self, lower: PaddedPanorama, upper: PaddedPanorama, lost: Flags | None = None) -> WorkingPair:
        """Return a pair in the working size; lost (H, W): pixels that are no evidence, None: all in view are."""
        seen = self.visible
        if lost is not None and lost.any():
            seen = seen & (self._sized(lost * np.uint8(255)) == 0)
        both = lower, upper
        images = [self._level(self._sized(np.ascontiguousarray(one.panorama)).astype(np.float32)) for one in both]
        coding_grey = (one.gain * coding_sigma(one.jpeg_steps, self._coding_frequencies) for one in both)
        sensor_grey = math.hypot(lower.noise_grey, upper.noise_grey)
        noise_grey = math.hypot(BAND_NOISE * sensor_grey, *coding_grey)
        return WorkingPair(images[0], images[1], seen, sensor_grey, noise_grey)

    def views(self, pair: WorkingPair) -> tuple[Views, Views]:
        """Return the views of a pair for surfaces, and for the floor."""
        one, two = (_smoothed(image) for image in (pair.lower, pair.upper))
        surfaces = self._views(_band_pass(one), _band_pass(two), pair)
        bounded = [_bounded_band_pass(image, pair.noise_grey) for image in (one, two)]
        return surfaces, self._views(bounded[0], bounded[1], pair)

    def _level(self, image: Floats) -> Floats:
        """Return an image (H, DIRECTIONS) in which the horizon of the floor is level."""
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)

    def _sized(self, image: Bytes) -> Bytes:
        """Return a panorama (H, W) in the working size of a full turn, 0 in directions that it does not show."""
        shown = cv2.resize(image, (len(self.shown), self.height), interpolation=cv2.INTER_AREA)
        if len(self.shown) == DIRECTIONS:
            return np.asarray(shown, np.uint8)
        whole = np.zeros((self.height, DIRECTIONS), np.uint8)
        whole[:, self.shown] = shown
        return whole

    def _views(self, lower: Floats, upper: Floats, pair: WorkingPair) -> Views:
        """Return the views of the band-passes of a pair (H, DIRECTIONS)."""
        one, two = np.empty((2, *lower.shape), np.uint8)
        for band, into in ((lower, one), (upper, two)):
            kernels.normalise(band, CONTRAST_ROWS, TEXTURE_SHARE**2, pair.noise_grey**2, UNITS, ZERO, into)
        upright, plane = np.empty((2, 2, *two.shape), np.uint8)
        kernels.bounds(two, upright)
        kernels.bounds_on_plane(two, self._plane_steps, plane)
        return Views(one, two, upright, plane, pair.seen * np.uint8(255))

    def _made_maps(self, a: float, b: float) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
        """Return the maps to a panorama in which the horizon of a floor with the slopes a, b is level."""
        azimuth = math.pi - (np.arange(DIRECTIONS) + 0.5) * (math.tau / DIRECTIONS)
        tilt = a * np.cos(azimuth) + b * np.sin(azimuth)
        rows = np.arange(self.height)[:, None]
        columns = np.broadcast_to(np.arange(DIRECTIONS, dtype=np.float32), (self.height, DIRECTIONS))
        places, shares = cv2.convertMaps(columns, (rows - FOCAL_PX * tilt).astype(np.float32), cv2.CV_16SC2)
        return np.asarray(places, np.int16), np.asarray(shares, np.uint16)


def _smoothed(image: Floats) -> Floats:
    """Return a panorama (H, DIRECTIONS) smoothed along columns."""
    return np.asarray(cv2.GaussianBlur(image, (1, 5), sigmaX=0.1, sigmaY=FINE_PX), np.float32)


def _band_pass(smooth: Floats) -> Floats:
    """Return a panorama (H, DIRECTIONS) less its coarse mean along columns."""
    band = np.empty_like(smooth)
    kernels.band_pass(smooth, COARSE_ROWS, band)
    return band


def _bounded_band_pass(smooth: Floats, noise_grey: float) -> Floats:
    """Return by how much a panorama (H, DIRECTIONS) exceeds its columns around, where no row counts much."""
    band = np.empty_like(smooth)
    kernels.bounded_band_pass(smooth, BOUNDED_ROWS, np.float32(BOUNDED_SIGMAS * noise_grey), band)
    return band
