"""Dewarping: mirror images to panoramas (Dang et al. 2012, section III.A)."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import Maps, remap_tables, visible
from drivers.jpeg import Steps
from omnid.config import PanoramaConfig
from omnid.core.nanoseconds import NS_PER_S
from omnid.core.odometry.line_times import RawImage
from omnid.core.stereo.photometry import brightened, gain_of, light, noise_sigma, pair_gains
from omnid.core.stereo.tiles import SIDES, Side, TileMonitor, tile_columns
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.pixel_times import PixelTimes
from omnid.errors import OmnidError
from omnid.messages import FramePair, Panoramas
from omnid.stages.geometry import Geometry

NOISE_NS = NS_PER_S  # Time between two measurements of the noise, because exposure changes it slowly.
BLUR_SHARE = 0.6  # sigma of the blur by the additional pixels that a pixel of the panorama covers


class Dewarp:
    """Rectifies both images of a pair."""

    def __init__(self, geometry: Geometry, config: PanoramaConfig) -> None:
        self._noise_grey: dict[Side, float] = {}  # noise of each camera before its gain
        self._measured_ns: int | None = None  # stamp of the pair in which the noise was measured last
        self._pad_px = config.pad_px
        rig, cylinder = geometry.rig, geometry.cylinder
        self._sector, self._scale = (cylinder.turn_px, cylinder.first), cylinder.scale
        self._lower, self._upper = (remap_tables(rig, one, cylinder, config.pad_px) for one in (rig.lower, rig.upper))
        self._blur_px = _blur_px((self._lower, self._upper))
        both = visible(rig.lower, self._lower, config.rim_margin_px)
        both &= visible(rig.upper, self._upper, config.rim_margin_px)
        self._visible = np.ascontiguousarray(_inner(both, config.margin_px)[:, config.pad_px : -config.pad_px])
        if not self._visible.any():
            raise OmnidError("the cameras share no part of the panorama: check the rig's transforms and masks")
        self._tiles = TileMonitor(self._visible, tile_columns(cylinder))
        self.upper_delay_s, line_s = rig.times.upper_delay_s, rig.times.line_time_s
        inner = slice(config.pad_px, -config.pad_px)
        lower, upper = (tuple(table[:, inner] for table in maps) for maps in (self._lower, self._upper))
        self.raw_images = (
            RawImage(lower[0], lower[1], rig.lower.camera.size),
            RawImage(upper[0], upper[1], rig.upper.camera.size),
        )
        self._rows_s = [maps[1][:, inner] * np.float32(line_s) for maps in (self._lower, self._upper) if line_s]

    def process(self, pair: FramePair) -> Panoramas:
        """Return the panoramas of a pair."""
        # 1. Rectify both images; the noise is measured in some of the pairs.
        since_ns = NOISE_NS if self._measured_ns is None else abs(pair.stamp_ns - self._measured_ns)
        if measured := since_ns >= NOISE_NS:
            self._measured_ns = pair.stamp_ns
        lower, lower_grey = self._remapped(pair.lower, self._lower, "lower", measured)
        upper, upper_grey = self._remapped(pair.upper, self._upper, "upper", measured)
        # 2. The light of each, and of the camera that shows less contrast, which decides how much there is.
        images: dict[Side, NDArray[np.uint8]] = {"lower": lower_grey, "upper": upper_grey}
        sums = {side: self._tiles.sums(side, image) for side, image in images.items()}
        lights = [light(sums[side], self._noise_grey[side]) for side in SIDES]
        dimmer = min(lights, key=lambda light: light.contrast_to_noise)
        # 3. Gains for dim images.
        by_level = gain_of(lights[0].level_grey), gain_of(lights[1].level_grey)
        lower_gain, upper_gain = pair_gains(sums["lower"], sums["upper"], by_level)
        # 4. Times of exposure of the pixels, and parts of the images that are dead or blind.
        times = PixelTimes(pair.skew_s + self.upper_delay_s, *self._rows_s)
        tiles = self._tiles.update(pair.stamp_ns, images, sums, self._noise_grey)
        return Panoramas(
            pair.seq,
            pair.stamp_ns,
            self._padded(lower, lower_gain, "lower", pair.jpeg_steps[0]),
            self._padded(upper, upper_gain, "upper", pair.jpeg_steps[1]),
            self._visible,
            times,
            dimmer,
            pair.motion,
            tiles,
        )

    def _remapped(
        self, image: NDArray[np.uint8], maps: Maps, camera: Side, measured: bool
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return a panorama as the camera gave it, with its padding and without.

        measured: measure the noise of this camera again.
        """
        smooth = cv2.GaussianBlur(image, (0, 0), self._blur_px) if self._blur_px else image
        remapped = np.asarray(cv2.remap(smooth, *maps, cv2.INTER_LINEAR), np.uint8)
        inner = np.ascontiguousarray(remapped[:, self._pad_px : -self._pad_px])
        if measured:
            self._noise_grey[camera] = noise_sigma(inner, self._visible)
        return remapped, inner

    def _padded(self, remapped: NDArray[np.uint8], gain: float, camera: Side, steps: Steps) -> PaddedPanorama:
        """Return a panorama multiplied by a gain; steps: of the quantisation of its JPEG."""
        noise_grey = gain * self._noise_grey[camera]
        image, of_turn = brightened(remapped, gain), (*self._sector, steps, self._scale)
        return PaddedPanorama(image, self._pad_px, noise_grey, gain, *of_turn)


def _blur_px(tables: tuple[Maps, ...]) -> float:
    """Return the sigma [px] of the blur of the images, so that a coarser panorama has no aliasing; 0: none.

    A pixel of a panorama that covers n pixels of the image has the blur that makes one of n.
    """
    steps = [np.hypot(np.diff(u, axis=1), np.diff(v, axis=1))[(u[:, 1:] >= 0) & (u[:, :-1] >= 0)] for u, v in tables]
    covered_px = float(np.median(np.concatenate(steps)))
    return BLUR_SHARE * math.sqrt(covered_px**2 - 1) if covered_px > 1 else 0.0


def _inner(region: NDArray[np.bool_], margin_px: int) -> NDArray[np.bool_]:
    """Return the region (H, W) without a margin along its border and along the first and last rows."""
    side = 2 * margin_px + 1
    inner = cv2.erode(region.astype(np.uint8), np.ones((side, side), np.uint8), borderValue=1) > 0
    inner[: margin_px + 1], inner[len(inner) - margin_px - 1 :] = False, False
    return inner
