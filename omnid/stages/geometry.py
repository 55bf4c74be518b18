"""Geometry of a run, and what is made of its pairs: panoramas (Dang et al. 2012, section III.A), and dense depth."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder, Maps, fit_cylinder, remap_tables, visible
from calib.rig import Rig
from calib.rim import find_rim
from drivers.frame import Camera, Frame
from omnid.config import PanoramaConfig, StereoConfig
from omnid.core.nanoseconds import NS_PER_S
from omnid.core.odometry.earlier_view import EarlierView, contradicted
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.line_times import RawImage
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.stereo.matcher import Matcher
from omnid.core.stereo.photometry import brightened, gain_of, light, noise_sigma, pair_gains
from omnid.core.stereo.tiles import SIDES, Side, TileMonitor, tile_columns
from omnid.core.stereo.triangulation import triangulate
from omnid.core.types.panorama import PaddedPanorama, Panoramas
from omnid.core.types.pixel_times import PixelTimes
from omnid.core.types.stereo_model import StereoModel
from omnid.engine.graph import Lock
from omnid.errors import OmnidError
from omnid.messages import DensePoints, FramePair, StereoDepth
from omnid.stages.synchronise import Decoder

Array = NDArray[np.float64]

RIM_FRAMES = 12  # frames of both cameras whose maximum is searched for the rims

NOISE_NS = NS_PER_S  # Time between two measurements of the noise, because exposure changes it slowly.
BLUR_SHARE = 0.6  # sigma of the blur as a fraction of sqrt(n^2 - 1), see _blur_px
DISPARITY_STEP_PX = 32  # the semi-global prior searches a multiple of it


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """A rig whose masks are known, and the panorama that fits it."""

    rig: Rig
    cylinder: Cylinder

    @property
    def T_rig_rect(self) -> Array:
        """Transform (4, 4) from the rectified frame, in which epipolar lines are columns, to the rig frame."""
        return se3.inverse(self.rig.T_rect_rig)

    @property
    def T_base_rect(self) -> Array:
        """Transform (4, 4) from the rectified frame to the base."""
        return np.asarray(self.rig.T_base_rig @ self.T_rig_rect)

    def model(self, noise_px: float) -> StereoModel:
        """Return the measurement model of corners located with a standard deviation of noise_px."""
        return StereoModel(self.cylinder, self.rig.baseline_m, noise_px)


def geometry(rig: Rig, config: PanoramaConfig) -> Geometry:
    """Return the geometry of a rig; the view of a camera without a mask is MountedCamera.visible."""
    return Geometry(rig, fit_cylinder(rig, config.width_px, config.elevation_deg, config.scale))


def with_rims(rig: Rig, frames: Iterable[Frame]) -> Rig:
    """Return the rig with masks of the mirrors' rims, found in the first images of cameras without a mask.

    A rim is sought in the maximum of the images: a single one may be dark on one side.
    """
    mounted = dict(rig.sides)
    missing = [name for name, camera in mounted.items() if camera.mask is None]
    decode, brightest = Decoder(rig), dict[Camera, NDArray[np.uint8]]()
    for frame in islice(frames, RIM_FRAMES if missing else 0):
        image = decode(frame)
        if image is not None:
            brightest[frame.camera] = np.maximum(brightest.get(frame.camera, image), image)
    for name in missing:
        rim = find_rim(brightest[name], mounted[name].camera.center) if name in brightest else None
        mounted[name] = replace(mounted[name], mask=rim)
    return replace(rig, lower=mounted["lower"], upper=mounted["upper"]) if brightest else rig


class Dewarp:
    """Rectifies both images of a pair."""

    def __init__(self, geometry: Geometry, config: PanoramaConfig) -> None:
        self._noise_grey: dict[Side, float] = {}  # noise of each camera before its gain
        self._measured_ns: int | None = None  # stamp of the pair in which the noise was measured last
        self._pad_px, self._unpadded = config.pad_px, np.s_[:, config.pad_px : -config.pad_px]
        rig, self._cylinder = geometry.rig, geometry.cylinder
        self._maps = {side: remap_tables(rig, one, self._cylinder, config.pad_px) for side, one in rig.sides}
        self._blur_px = _blur_px([*self._maps.values()])
        both = np.logical_and(*(visible(one, self._maps[side], config.rim_margin_px) for side, one in rig.sides))
        self._visible = np.ascontiguousarray(_without_margin(both, config.margin_px)[self._unpadded])
        if not self._visible.any():
            raise OmnidError("the cameras share no part of the panorama: check the rig's transforms and masks")
        self._tiles = TileMonitor(self._visible, tile_columns(self._cylinder))
        self._upper_delay_s, line_s = rig.times.upper_delay_s, rig.times.line_time_s
        (lower_u, lower_v), (upper_u, upper_v) = ([one[self._unpadded] for one in maps] for maps in self._maps.values())
        self.raw_images = (
            RawImage(lower_u, lower_v, rig.lower.camera.size),
            RawImage(upper_u, upper_v, rig.upper.camera.size),
        )
        self._rows_s = [rows * np.float32(line_s) for rows in (lower_v, upper_v)] if line_s else []

    def process(self, pair: FramePair) -> Panoramas:
        """Return the panoramas of a pair."""
        # 1. Rectify both images, with the padding and without; the noise is measured in some of the pairs.
        padded, grey = dict[Side, NDArray[np.uint8]](), dict[Side, NDArray[np.uint8]]()
        for side, image in zip(SIDES, (pair.lower, pair.upper), strict=True):
            smooth = cv2.GaussianBlur(image, (0, 0), self._blur_px) if self._blur_px else image
            padded[side] = np.asarray(cv2.remap(smooth, *self._maps[side], cv2.INTER_LINEAR), np.uint8)
            grey[side] = np.ascontiguousarray(padded[side][self._unpadded])
        if self._measured_ns is None or abs(pair.stamp_ns - self._measured_ns) >= NOISE_NS:
            self._measured_ns = pair.stamp_ns
            self._noise_grey = {side: noise_sigma(grey[side], self._visible) for side in SIDES}
        # 2. The light of each image; the dimmer one, with less contrast, counts for the pair.
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
                cylinder.period_px,
                cylinder.first,
                steps,
                cylinder.scale,
            )
            for side, steps in zip(SIDES, pair.jpeg_steps, strict=True)
        )
        # 4. Exposure times of the pixels, and tiles of the images that are dead or blind.
        times = PixelTimes(pair.skew_s + self._upper_delay_s, *self._rows_s)
        tiles = self._tiles.update(grey, sums, self._noise_grey)
        return Panoramas(pair.seq, pair.stamp_ns, lower, upper, self._visible, times, dimmer, pair.motion, tiles)


def _blur_px(tables: Sequence[Maps]) -> float:
    """Return the sigma [px] of the blur of the images, so that a coarser panorama has no aliasing; 0: none.

    A pixel of the panorama covers n pixels of the image; the blur averages over them.
    """
    steps = [np.hypot(np.diff(u, axis=1), np.diff(v, axis=1))[(u[:, 1:] >= 0) & (u[:, :-1] >= 0)] for u, v in tables]
    covered_px = float(np.median(np.concatenate(steps)))
    return BLUR_SHARE * math.sqrt(covered_px**2 - 1) if covered_px > 1 else 0.0


def _without_margin(region: NDArray[np.bool_], margin_px: int) -> NDArray[np.bool_]:
    """Return the region (H, W) without a margin along its border and along the first and last rows."""
    side = 2 * margin_px + 1
    inner = cv2.erode(region.astype(np.uint8), np.ones((side, side), np.uint8), borderValue=1) > 0
    inner[: margin_px + 1], inner[len(inner) - margin_px - 1 :] = False, False
    return inner


def stereo_frame(
    pair: Panoramas,
    disparities: Callable[[Exposure | None], NDArray[np.float32]],
    interval_s: tuple[float, float] | None = None,
) -> StereoFrame:
    """Return a pair as odometry and places take it; disparities, interval_s: see StereoFrame."""
    usable = np.zeros_like(pair.visible) if pair.light.is_noise else pair.usable
    lost = pair.tiles.lost_pixels(pair.visible.shape)
    return StereoFrame(pair.seq, pair.lower, pair.upper, disparities, usable, pair.times, interval_s, lost=lost)


class DenseDepths:
    """Dense depths, computed when they are first asked for.

    Matching costs as much as the odometry of a pair, and few pairs need it: keyframes, and those that enter the map or
    the obstacle scan. What was computed is remembered as long as the panoramas of the pair exist. Any thread may ask;
    while one computes, others that ask for the same pair wait for the result.
    """

    def __init__(self, geometry: Geometry, config: StereoConfig) -> None:
        self._config, self._cylinder, self._baseline_m = config, geometry.cylinder, geometry.rig.baseline_m
        self._T_rig_rect = geometry.T_rig_rect
        # Disparities up to those of the nearest points; rows are left beyond the largest one.
        height, step_px = geometry.cylinder.height, DISPARITY_STEP_PX
        limit = (height - step_px // 2) // step_px * step_px
        if limit < step_px:
            raise OmnidError(
                f"the panoramas are {height} px high, stereo needs at least {step_px + step_px // 2} px: use "
                "larger images, or a rig whose cameras share more of their view"
            )
        nearest_px = self._cylinder.focal_px * self._baseline_m / config.min_range_m
        disparities = min(config.matching.disparities, math.ceil(nearest_px / step_px) * step_px, limit)
        self._matching = replace(config.matching, disparities=disparities)
        self._idle: deque[Matcher] = deque()  # matchers with their buffers: one for each thread that matches
        self._cache: WeakKeyDictionary[Panoramas, tuple[dict[object, DensePoints], Lock]] = WeakKeyDictionary()
        self._cache_lock = Lock()

    def of(self, depth: StereoDepth) -> DensePoints:
        """Return the dense depth of a pair whose pose is known: points that its earlier view does not contradict."""
        dense, earlier = self.points(depth.panoramas, depth.exposure), depth.earlier
        if earlier is None:
            return dense
        compute = partial(self._confirm, depth.panoramas.lower, dense, earlier)
        return self._cached(depth.panoramas, (depth.exposure, earlier), compute)

    def points(self, panoramas: Panoramas, exposure: Exposure | None = None) -> DensePoints:
        """Return disparities and their points in the rig frame, as matched, at the stamp of the pair.

        exposure: the motion during the exposures; None: unknown.
        """
        exposure = None if exposure is None or exposure.times.is_synchronised else exposure
        return self._cached(panoramas, exposure, partial(self._compute, panoramas, exposure))

    def _cached(self, panoramas: Panoramas, key: object, compute: Callable[[], DensePoints]) -> DensePoints:
        """Return the depth of a pair, computed once per key, the inputs it depends on; other threads wait meanwhile."""
        with self._cache_lock:
            cached, lock = self._cache.setdefault(panoramas, ({}, Lock()))
        with lock:
            if key not in cached:
                cached[key] = compute()
            return cached[key]

    def _compute(self, panoramas: Panoramas, exposure: Exposure | None) -> DensePoints:
        """Return the depth of panoramas, corrected for a motion during their exposures."""
        # 1. Match the pixels of the lower panorama along their columns.
        lower, pad = panoramas.lower, panoramas.lower.pad_px
        valid = np.pad(panoramas.usable, ((0, 0), (pad, pad)))
        shift = None if exposure is None else exposure.column_shift(panoramas.visible.shape, pad)
        try:
            matcher = self._idle.pop()
        except IndexError:
            matcher = Matcher(lower.image.shape[:2], self._matching)
        flat, found = matcher.match(lower.image, panoramas.upper.image, valid, lower.noise_grey, shift)
        self._idle.append(matcher)
        rows, columns = np.divmod(flat, lower.image.shape[1])
        columns -= pad
        # 2. Correct rows and disparities to the stamp of the pair.
        views, motion_variance = np.column_stack([columns, rows, rows + found]).astype(float), np.zeros(len(found))
        if exposure is not None:
            views, motion_model = exposure.corrected(views[:, :2], views[:, 2])
            noise = motion_model.noise
            motion_variance = noise[:, 1, 1] + noise[:, 2, 2] - 2 * noise[:, 1, 2]
        disparity = np.full(panoramas.visible.shape, np.nan, np.float32)
        disparity[rows, columns] = views[:, 2] - views[:, 1]
        # 3. Triangulate, with the variance along the ray: the distance from the axis is r = f t / d, so sigma_r is
        #    r^2 / (f t) sigma_d, and sqrt(1 + z^2 / r^2) times as large along the ray.
        points = triangulate(views, self._cylinder, self._baseline_m)
        kept = np.isfinite(points).all(axis=1)
        points = points[kept]
        r2, z2 = (points[:, :2] ** 2).sum(axis=1), points[:, 2] ** 2
        per_px = r2 / (self._cylinder.focal_px * self._baseline_m)
        variance_m2 = (1 + z2 / r2) * per_px**2 * (self._config.noise_px**2 + motion_variance[kept])
        pixels = np.column_stack([columns, rows])[kept].astype(float)
        return DensePoints(disparity, pixels, se3.apply(self._T_rig_rect, points), variance_m2)

    def _confirm(self, lower: PaddedPanorama, dense: DensePoints, earlier: EarlierView) -> DensePoints:
        """Return the dense points of a pair without those that its earlier view contradicts."""
        points = se3.apply(se3.inverse(self._T_rig_rect), dense.points)
        wrong = contradicted(lower, dense.pixels, points, self._cylinder, earlier)
        disparity = dense.disparity.copy()
        columns, rows = dense.pixels[wrong].astype(np.intp).T
        disparity[rows, columns] = np.nan
        return DensePoints(disparity, dense.pixels[~wrong], dense.points[~wrong], dense.variance_m2[~wrong])
