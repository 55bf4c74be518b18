"""Exposure of both live cameras: grey levels of the useful part of their images, the law, its requests and status.

The exposure time is raised first, to its limit, because gain magnifies the noise; the gain is lowered first. Both
cameras have the same values, so that a point has the same brightness in both. Steps are rare and bounded: images on
either side of one are compared by patches with a gain of their own (`core/odometry/plane_patches.py`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from calib.panorama import Cylinder, remap_tables, visible
from calib.rig import Rig
from drivers.cameras.camera_state import (
    CameraExposure,
    CameraState,
    ExposureRanges,
    ExposureRequest,
    ExposureSetting,
    ValueRange,
)
from drivers.frame import Camera
from omnid.config import CamerasConfig
from omnid.core.nanoseconds import NS_PER_S, S_PER_NS
from omnid.messages import FramePair

SAMPLED_COLUMNS: Final = 160  # of the panorama: some thousand samples
TARGET, SATURATED = 100.0, 250.0  # grey levels: the mean that is regulated to, and saturation
# Dead band: a factor of the light below this one causes no step, so that a step down causes none up. Its square is the
# largest step. A saturated area is assumed to be too bright by this factor, by which bright spots may lower the mean.
BAND: Final = math.sqrt(2)
STEP_S: Final = 0.5  # between two steps: images show a step only some frames later
USUAL_HZ: Final = 30.0  # rate of cameras that keep their own


class GreyLevels(NamedTuple):
    """Grey levels of an image in the useful area."""

    mean: float
    bright: float  # all but the brightest 3 % are below


class UsefulArea:
    """The pixels of both images that the panoramas are made of, evenly spread over the panorama."""

    def __init__(self, rig: Rig, cylinder: Cylinder) -> None:
        coarse = cylinder.resized(SAMPLED_COLUMNS)
        sides = [(mounted, remap_tables(rig, mounted, coarse)) for mounted in (rig.lower, rig.upper)]
        # A sample is rounded to a pixel, which may lie beyond rim and hub without a margin of one.
        both = np.logical_and(*(visible(mounted, maps, 1.0) for mounted, maps in sides))
        # Rows and columns in each image.
        self._pixels = [(v[both].round().astype(np.intp), u[both].round().astype(np.intp)) for _, (u, v) in sides]

    def levels(self, pair: FramePair) -> tuple[GreyLevels, GreyLevels]:
        """Return the levels of the lower and of the upper image."""
        greys = (image[at] for image, at in zip((pair.lower, pair.upper), self._pixels, strict=True))
        lower, upper = (GreyLevels(float(grey.mean()), float(np.percentile(grey, 97))) for grey in greys)
        return lower, upper


def wanted_factor(lower: GreyLevels, upper: GreyLevels) -> float:
    """Return the factor by which the light of both cameras should change, between 1 / BAND^2 and BAND^2."""
    mean, bright = max(1.0, math.sqrt(lower.mean * upper.mean)), max(1.0, lower.bright, upper.bright)
    factor = min(TARGET / mean, 1 / BAND if bright >= SATURATED else SATURATED / bright)
    factor = max(factor, TARGET / BAND / mean)  # lamps and windows are small: the rest shall stay visible
    return min(max(factor, 1 / BAND**2), BAND**2)


class ExposureLaw:
    """Decides on steps by the levels of pairs; reads no clock."""

    def __init__(
        self, ranges: ExposureRanges, start: ExposureSetting, limit_us: float, flicker_us: float = 0.0
    ) -> None:
        """limit_us: of the exposure time. flicker_us: period of the lamps' light, 0: unknown.

        A longer exposure is a multiple of flicker_us, so that all images get the same light.
        """
        times, self._flicker_us = ranges.exposure_us, flicker_us
        self._times = ValueRange(times.low, max(times.low, min(times.high, int(limit_us))), times.step)
        self._gains = ranges.gain or ValueRange(0, 0)
        # A step of the gain is a part of its range, since its unit is not known.
        self._gain_step = max(self._gains.step, (self._gains.high - self._gains.low) // 16)
        self._has_gain = ranges.gain is not None
        self._time_us = self._time(start.exposure_us)
        self._gain = self._gains.nearest(start.gain or self._gains.low)
        self.state: Literal["regulated", "too dark", "too bright"] = "regulated"
        self.steps = 0
        self._next_ns: float = -math.inf

    @property
    def setting(self) -> ExposureSetting:
        """The setting that is wanted now."""
        return ExposureSetting(self._time_us, self._gain if self._has_gain else None)

    def step(self, lower: GreyLevels, upper: GreyLevels, stamp_ns: int) -> ExposureSetting | None:
        """Return the setting from now on; None where it stays. The levels are those of images at the stamp."""
        if stamp_ns < self._next_ns:
            return None
        # 1. The factor on the light that is wanted, and the setting that is nearest to it, with a dead band.
        factor, time_us, gain = wanted_factor(lower, upper), self._time_us, self._gain
        self.state = "regulated"
        if 1 / BAND < factor < BAND:
            return None
        if factor > 1:
            time_us = max(time_us, self._time(time_us * factor))
            if time_us == self._time_us:
                gain = self._gains.nearest(gain + self._gain_step)
        else:  # where the images are very bright, exposure and gain are lowered at once
            if gain == self._gains.low or factor <= 1 / BAND**2:
                time_us = min(time_us, self._time(time_us * factor))
            gain = self._gains.nearest(gain - self._gain_step)
        # 2. At the end of the range it stays, and where a coarse step of the time would lead farther beyond the wanted
        #    light than it is away now.
        if (time_us, gain) == (self._time_us, self._gain):
            self.state = "too dark" if factor > 1 else "too bright"
            return None
        if gain == self._gain and abs(math.log(time_us / self._time_us)) > 2 * abs(math.log(factor)):
            return None
        self._next_ns = stamp_ns + STEP_S / S_PER_NS
        self._time_us, self._gain, self.steps = time_us, gain, self.steps + 1
        return self.setting

    def _time(self, wanted_us: float) -> int:
        """Return the nearest exposure time that the camera and the lamps allow."""
        time_us = self._times.nearest(wanted_us)
        if self._flicker_us and time_us > self._flicker_us:
            time_us = self._times.nearest(time_us // self._flicker_us * self._flicker_us)
        return time_us


class ExposureControl:
    """A sink of the pairs of a live run: measures grey levels, and regulates the exposure.

    It makes requests only if cameras.auto_exposure is "rig" and both cameras offer an exposure time.
    """

    def __init__(self, area: UsefulArea, config: CamerasConfig, cameras: Mapping[Camera, CameraState]) -> None:
        self._area, self._config = area, config
        self._exposures = [state.exposure for state in cameras.values() if state.exposure is not None]
        self._period_ns = NS_PER_S / (config.rate_hz or USUAL_HZ)
        self._law: ExposureLaw | None = None
        self._levels: tuple[GreyLevels, GreyLevels] | None = None  # of the newest measured pair
        self._next_ns: float = -math.inf
        # Why the exposure is left to the cameras; empty where it is not.
        self._left_to_cameras = ""
        if config.exposure_us:
            self._left_to_cameras = "fixed by cameras.exposure_us"
        elif config.auto_exposure != "rig":
            self._left_to_cameras = f'left to the cameras: cameras.auto_exposure = "{config.auto_exposure}"'
        elif len(self._exposures) < len(cameras):
            self._left_to_cameras = "left to the cameras: no exposure time to set in one of them"
        elif (times := _ranges(self._exposures).exposure_us).low > times.high:
            self._left_to_cameras = "left to the cameras: their exposure times have no value in common"

    def process(self, pair: FramePair) -> None:
        """Measure a pair if it is due, and make a request where the law takes a step."""
        if pair.stamp_ns < self._next_ns:
            return
        self._next_ns = pair.stamp_ns + STEP_S / S_PER_NS
        self._levels = self._area.levels(pair)
        if self._left_to_cameras:
            return
        if problem := next((exposure.problem for exposure in self._exposures if exposure.problem), ""):
            self._left_to_cameras = f"left to the cameras: {problem}"
            self._request(None, pair.stamp_ns)
        elif self._law is None:  # start from the setting of the lower camera
            # The longest exposure leaves a tenth of the images' period to read the image out.
            limit_us = min(1e3 * self._config.exposure_limit_ms, 0.9e-3 * self._period_ns)
            start = self._exposures[0].in_force or ExposureSetting(int(limit_us))
            mains = self._config.power_line
            flicker_us = 1e6 / (2 * int(mains)) if mains.isdecimal() else 0.0  # lamps shine twice a period
            self._law = ExposureLaw(_ranges(self._exposures), start, limit_us, flicker_us)
            self._request(self._law.setting, pair.stamp_ns)
        elif (wanted := self._law.step(*self._levels, pair.stamp_ns)) is not None:
            self._request(wanted, pair.stamp_ns)

    def stats(self) -> dict[str, object]:
        """Return exposure, gain and grey levels, and whether it is too dark or too bright."""
        stats: dict[str, object] = {"state": self._left_to_cameras or "no images yet"}
        if self._levels is not None:
            stats |= zip(("lower_grey", "upper_grey"), (round(one.mean) for one in self._levels), strict=True)
        if self._law is not None and not self._left_to_cameras:
            setting = self._law.setting
            gain = "" if setting.gain is None else setting.gain
            stats |= {"state": self._law.state, "steps": self._law.steps, "gain": gain}
            stats["exposure_ms"] = setting.exposure_us * 1e-3
            if self._law.state != "regulated":
                stats["_warning"] = f"{self._law.state}: exposure time and gain are at their limits"
        return stats

    def _request(self, setting: ExposureSetting | None, stamp_ns: int) -> None:
        """Ask both cameras for a setting; None: they regulate themselves."""
        for exposure in self._exposures:
            # From the middle of the next period on, so that both cameras carry it out after the same pair.
            exposure.request = ExposureRequest(setting, stamp_ns + int(1.5 * self._period_ns))


def _ranges(exposures: Sequence[CameraExposure]) -> ExposureRanges:
    """Return the ranges that both cameras have."""
    lower, upper = (exposure.ranges for exposure in exposures)
    gains = None if lower.gain is None or upper.gain is None else lower.gain.common(upper.gain)
    return ExposureRanges(lower.exposure_us.common(upper.exposure_us), gains)
