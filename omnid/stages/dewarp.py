"""Dewarping: mirror images to panoramas (Dang et al. 2012, section III.A)."""

from __future__ import annotations

import math
from collections.abc import Sequence

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
from omnid.core.types.panorama import PaddedPanorama, Panoramas
from omnid.core.types.pixel_times import PixelTimes
from omnid.errors import OmnidError
from omnid.messages import FramePair
from omnid.stages.geometry import Geometry

NOISE_NS = NS_PER_S  # Time between two measurements of the noise, because exposure changes it slowly.
BLUR_SHARE = 0.6  # sigma of the blur by the additional pixels that a pixel of the panorama covers


class Dewarp:
    """Rectifies both images of a pair."""

    def __init__(self, geometry: Geometry, config: PanoramaConfig) -> None:
        self._noise_grey: dict[Side, float] = {}  # noise of each camera before its gain
        self._measured_ns: int | None = None  # stamp of the pair in which the noise was measured last
        self._pad_px, self._inner = config.pad_px, np.s_[:, config.pad_px : -config.pad_px]
        rig, self._cylinder = geometry.rig, geometry.cylinder
        self._lower, self._upper = tables = [
            remap_tables(rig, one, self._cylinder, config.pad_px) for one in (rig.lower, rig.upper)
        ]
        self._blur_px = _blur_px(tables)
        both = visible(rig.lower, self._lower, config.rim_margin_px)
        both &= visible(rig.upper, self._upper, config.rim_margin_px)
        self._visible = np.ascontiguousarray(_inner(both, config.margin_px)[self._inner])
        if not self._visible.any():
            raise OmnidError("the cameras share no part of the panorama: check the rig's transforms and masks")
        self._tiles = TileMonitor(self._visible, tile_columns(self._cylinder))
        self._upper_delay_s, line_s = rig.times.upper_delay_s, rig.times.line_time_s
        (lower_u, lower_v), (upper_u, upper_v) = ([table[self._inner] for table in maps] for maps in tables)
        self.raw_images = (
            RawImage(lower_u, lower_v, rig.lower.camera.size),
            RawImage(upper_u, upper_v, rig.upper.camera.size),
        )
        self._rows_s = [rows * np.float32(line_s) for rows in (lower_v, upper_v)] if line_s else []

    def process(self, pair: FramePair) -> Panoramas:
        """Return the panoramas of a pair."""
        # 1. Rectify both images, with the padding and without; the noise is measured in some of the pairs.
        raw: dict[Side, tuple[NDArray[np.uint8], Maps, Steps]] = {
            "lower": (pair.lower, self._lower, pair.jpeg_steps[0]),
            "upper": (pair.upper, self._upper, pair.jpeg_steps[1]),
        }
        padded, grey = dict[Side, NDArray[np.uint8]](), dict[Side, NDArray[np.uint8]]()
        for side, (image, maps, _) in raw.items():
            smooth = cv2.GaussianBlur(image, (0, 0), self._blur_px) if self._blur_px else image
            padded[side] = np.asarray(cv2.remap(smooth, *maps, cv2.INTER_LINEAR), np.uint8)
            grey[side] = np.ascontiguousarray(padded[side][self._inner])
        if self._measured_ns is None or abs(pair.stamp_ns - self._measured_ns) >= NOISE_NS:
            self._measured_ns = pair.stamp_ns
            self._noise_grey = {side: noise_sigma(grey[side], self._visible) for side in SIDES}
        # 2. The light of each, and of the camera that shows less contrast, which decides how much there is.
        sums = {side: self._tiles.sums(side, grey[side]) for side in SIDES}
        lights = [light(sums[side], self._noise_grey[side]) for side in SIDES]
        dimmer = min(lights, key=lambda light: light.contrast_to_noise)
        # 3. Gains for dim images.
        by_level = gain_of(lights[0].level_grey), gain_of(lights[1].level_grey)
        gains = dict(zip(SIDES, pair_gains(sums["lower"], sums["upper"], by_level), strict=True))
        cylinder = self._cylinder
        lower, upper = (
            PaddedPanorama(
                brightened(padded[side], gains[side]),
                self._pad_px,
                gains[side] * self._noise_grey[side],
                gains[side],
                cylinder.turn_px,
                cylinder.first,
                raw[side][2],
                cylinder.scale,
            )
            for side in SIDES
        )
        # 4. Times of exposure of the pixels, and parts of the images that are dead or blind.
        times = PixelTimes(pair.skew_s + self._upper_delay_s, *self._rows_s)
        tiles = self._tiles.update(grey, sums, self._noise_grey)
        return Panoramas(pair.seq, pair.stamp_ns, lower, upper, self._visible, times, dimmer, pair.motion, tiles)


def _blur_px(tables: Sequence[Maps]) -> float:
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
