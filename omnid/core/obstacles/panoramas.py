"""Panoramas of a pair in one working size, in units of what two views of one place differ by.

Matching compares a pixel with what another view shows there, so an image is given by how it differs from its column
around. For the floor no row around counts much: no strong edge, such as that of a painted line, hides the weak texture
next to it. It is divided by `sqrt(noise^2 + (share * contrast)^2)`, the standard deviation of the difference of views.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from drivers.jpeg import coding_sigma
from omnid.core.obstacles.evidence_kernels import bounded_band_pass
from omnid.core.types.panorama import PaddedPanorama

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Flags = NDArray[np.bool_]

DIRECTIONS: Final = 480  # columns of the working panorama, 0.75 degrees, because a pole of 3 cm is as wide at 2 m
AZIMUTHS: Final = math.pi - (np.arange(DIRECTIONS) + 0.5) * (math.tau / DIRECTIONS)  # of directions, rectified frame
FOCAL_PX: Final = 139.0  # rows of the working panorama in a radian, because images of 512 px have that resolution
FINE_PX: Final = 0.8  # sigma of the smoothing along columns, because views differ by parts of a row
AROUND_ROWS: Final = 17  # rows with which a pixel is compared
# Difference between two views of a surface, by the local contrast; noise is added to it. Measured: with 0.2 and 0.45
# 8.5 and 15.5 % of the directions of things are called free beyond these instead of 11.1 %.
TEXTURE_SHARE: Final = 0.3
# Noise of a smooth image by that of a panorama: of white noise in images of 512 px 0.54 to 0.66 in the rows of floor,
# of 960 px 0.36 to 0.53. With 0.35, by trial, bases stood before free floor in noisy images.
BAND_NOISE: Final = 0.65
# Frequencies of a JPEG's blocks, of 8, whose errors a working panorama of the image's own resolution shows, because the
# smoothing halves those above. A coarser panorama shows fewer.
CODING_FREQUENCIES: Final = 3.0
UNITS: Final = 12.0  # levels of a normalised image in one sigma, because 8 bits hold ten sigmas either way
# Most that one row around counts, in sigmas of the noise, because the edge of a painted line has a hundred and hid the
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

    def __init__(
        self,
        cylinder: Cylinder,
        tilt: tuple[float, float],
        floor_slope: float,
        visible: Flags,
        *,
        is_steep: bool = False,
    ) -> None:
        """tilt: slopes of the floor in the rectified frame; floor_slope: change of its disparity from row to row.

        visible (H, W): pixels of a panorama that both cameras see. is_steep: a ramp, which is seen nearer than the
        floor: there are so many more rows as it is lifted.
        """
        # A sector has a whole number of directions (calib.panorama.SECTOR_STEPS); in the others nothing is seen.
        by_column = DIRECTIONS / cylinder.turn_px
        self.shown = np.arange(round(by_column * cylinder.width)) + round(by_column * cylinder.first)
        self.shown %= DIRECTIONS
        self._shown_rows = round(cylinder.height * FOCAL_PX / cylinder.focal_px)
        self.row0 = (cylinder.row0 + 0.5) * self._shown_rows / cylinder.height - 0.5
        rise_px = FOCAL_PX * (tilt[0] * np.cos(AZIMUTHS) + tilt[1] * np.sin(AZIMUTHS))
        self.height = self._shown_rows + (math.ceil(rise_px.max()) if is_steep else 0)
        self._coding_frequencies = max(2, round(CODING_FREQUENCIES * FOCAL_PX / cylinder.focal_px))
        rows = np.arange(self.height)
        self.plane_rows = (rows + floor_slope * np.maximum(rows - self.row0, 0.0)).astype(np.float32)
        self._plane_map = _map_of(np.broadcast_to(self.plane_rows[:, None], (self.height, DIRECTIONS)))
        self._level_map = _map_of(rows[:, None] - rise_px) if any(tilt) else None
        self._is_steep = is_steep
        self.visible = self._mask(visible) > 127  # (H, DIRECTIONS)

    def pair(self, lower: PaddedPanorama, upper: PaddedPanorama, lost: Flags | None = None) -> WorkingPair:
        """Return a pair in the working size; lost (H, W): pixels that are no evidence, None: all in view are."""
        seen = self.visible
        if lost is not None and lost.any():
            seen = seen & (self._mask(lost) == 0)
        both = lower, upper
        images = [self._sized(np.ascontiguousarray(one.panorama)).astype(np.float32) for one in both]
        if self._level_map is not None:
            images = [_remapped(image, self._level_map) for image in images]
        coding_grey = (one.gain * coding_sigma(one.jpeg_steps, self._coding_frequencies) for one in both)
        sensor_grey = math.hypot(lower.noise_grey, upper.noise_grey)
        noise_grey = math.hypot(BAND_NOISE * sensor_grey, *coding_grey)
        return WorkingPair(images[0], images[1], seen, sensor_grey, noise_grey)

    def views(self, pair: WorkingPair) -> tuple[Views, Views]:
        """Return the views of a pair for surfaces, and for the floor."""
        live = pair.seen * np.uint8(255)
        smooth = [cv2.GaussianBlur(image, (1, 5), sigmaX=0.1, sigmaY=FINE_PX) for image in (pair.lower, pair.upper)]
        found = []
        for most in (math.inf, BOUNDED_SIGMAS * pair.noise_grey):
            lower, upper = (_normalised(np.asarray(image, np.float32), most, pair.noise_grey) for image in smooth)
            plane = _half_row_bounds(_remapped(upper, self._plane_map))
            found.append(Views(lower, upper, _half_row_bounds(upper), plane, live))
        return found[0], found[1]

    def _mask(self, flags: Flags) -> Bytes:
        """Return flags of a panorama (H, W) in the working size, 255 where they are set."""
        sized = self._sized(flags * np.uint8(255))
        return _remapped(sized, self._level_map) if self._is_steep and self._level_map is not None else sized

    def _sized(self, image: Bytes) -> Bytes:
        """Return a panorama (H, W) in the working size of a full turn, 0 in directions that it does not show."""
        shown = cv2.resize(image, (len(self.shown), self._shown_rows), interpolation=cv2.INTER_AREA)
        if len(self.shown) == DIRECTIONS:
            return np.asarray(shown, np.uint8)
        whole = np.zeros((self._shown_rows, DIRECTIONS), np.uint8)
        whole[:, self.shown] = shown
        return whole


Map = tuple[NDArray[np.int16], NDArray[np.uint16]]
Pixels = TypeVar("Pixels", Floats, Bytes)


def _map_of(rows: NDArray[np.floating]) -> Map:
    """Return the map of OpenCV by which each pixel (H, DIRECTIONS) shows another row of its column."""
    columns = np.broadcast_to(np.arange(DIRECTIONS, dtype=np.float32), rows.shape)
    places, shares = cv2.convertMaps(columns, rows.astype(np.float32), cv2.CV_16SC2)
    return np.asarray(places, np.int16), np.asarray(shares, np.uint16)


def _remapped(image: Pixels, by: Map) -> Pixels:
    """Return an image whose pixels show what a map says."""
    return np.asarray(cv2.remap(image, *by, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), image.dtype)


def _normalised(smooth: Floats, most: float, noise_grey: float) -> Bytes:
    """Return by how much a panorama (H, DIRECTIONS) exceeds its columns around, in sigmas of the difference of views.

    most: that one row around counts. Levels are UNITS a sigma about the middle of 8 bits.
    """
    band = np.empty_like(smooth)
    bounded_band_pass(smooth, AROUND_ROWS, np.float32(most), band)
    contrast2 = cv2.blur(band * band, (3, AROUND_ROWS))
    sigma = np.sqrt(np.float32(noise_grey**2) + np.float32(TEXTURE_SHARE**2) * contrast2)
    return np.asarray(np.clip(np.float32(UNITS) * band / sigma + np.float32(128.5), 0.0, 255.0), np.uint8)


def _half_row_bounds(image: Bytes) -> Bytes:
    """Return the least and the most (2, H, DIRECTIONS) of an image within half a row of each pixel."""
    above, below = np.concatenate([image[:1], image[:-1]]), np.concatenate([image[1:], image[-1:]])
    half_above, half_below = (cv2.addWeighted(image, 0.5, other, 0.5, 0.0) for other in (above, below))
    least = cv2.min(cv2.min(half_above, half_below), image)
    return np.stack([least, cv2.max(cv2.max(half_above, half_below), image)])
