"""Grey levels of the useful part of an image, and the law that brings them into the middle by exposure and gain.

The exposure time is raised first, to its limit, because gain magnifies the noise; the gain is lowered first. Both
cameras have the same values, so that a point has the same brightness in both. Steps are rare and bounded: images on
either side of one are compared by patches with a gain of their own (`core/odometry/plane_patches.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder, remap_tables, visible
from calib.rig import MountedCamera, Rig
from drivers.cameras.camera_state import ExposureRanges, ExposureSetting, ValueRange
from omnid.core.nanoseconds import S_PER_NS
from omnid.messages import FramePair

SAMPLE_STEP: Final = 8  # columns and rows of the panorama from sample to sample: some thousand samples
LEAST_COLUMNS: Final = 64
BRIGHT_PERCENT: Final = 97.0
MARGIN_PX: Final = 2.0  # Distance kept from the rim and the hub.


@dataclass(frozen=True, slots=True)
class GreyLevels:
    """Grey levels of an image in the useful area."""

    mean: float
    bright: float  # all but the brightest 3 % are below


class UsefulArea:
    """The pixels of both images that the panoramas are made of, evenly spread over the panorama."""

    def __init__(self, rig: Rig, cylinder: Cylinder) -> None:
        coarse = cylinder.resized(max(LEAST_COLUMNS, cylinder.width // SAMPLE_STEP))
        sides = [(mounted, remap_tables(rig, mounted, coarse)) for mounted in (rig.lower, rig.upper)]
        both = np.logical_and(*(visible(mounted, maps, MARGIN_PX) for mounted, maps in sides))
        self._pixels = [_flat(mounted, maps[0][both], maps[1][both]) for mounted, maps in sides]

    def levels(self, pair: FramePair) -> tuple[GreyLevels, GreyLevels]:
        """Return the levels of the lower and of the upper image."""
        lower, upper = (
            _levels(image.ravel()[pixels]) for image, pixels in zip((pair.lower, pair.upper), self._pixels, strict=True)
        )
        return lower, upper


def _flat(mounted: MountedCamera, u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return indices into the flattened image of pixels (u, v)."""
    return np.asarray(v.round().astype(np.intp) * mounted.camera.size[0] + u.round().astype(np.intp))


def _levels(grey: NDArray[np.uint8]) -> GreyLevels:
    return GreyLevels(float(grey.mean()), float(np.percentile(grey, BRIGHT_PERCENT)))


# Grey levels: the wanted mean, the least mean that bright spots may cause, the wanted level of bright spots, and the
# level from which they count as saturated.
TARGET, LEAST_MEAN, BRIGHT, SATURATED = 100.0, 60.0, 235.0, 250.0
SATURATED_FACTOR: Final = 0.7  # The exposure is multiplied by this while bright spots are saturated.
# Wanted factors between these cause no step: after a step down the factor must not be large enough for a step up.
LEAST_DOWN, LEAST_UP = 0.77, 1.4
NEW_LIMIT: Final = 0.1  # Change of the limit of the exposure time from which it is taken: stamps have jitter.
LARGEST_FACTOR: Final = 2.0  # Largest factor of a step.
VERY_BRIGHT: Final = 0.6  # If the factor is smaller, the exposure is lowered at once, together with the gain.
GAIN_STEPS: Final = 8  # The first step of the gain is its range by this number, since its unit is not known.
# Time between two steps. A step against the last one doubles it, two steps in one direction reset it, against hunting.
STEP_S, LONGEST_STEP_S = 0.5, 32.0
# A camera does not answer if this number of successive steps of the exposure time, by at least the factor, do not
# change the mean as much as ANSWER while it is neither black nor white.
DEAF_STEPS, DEAF_FACTOR, ANSWER, SEEN_GREY = 4, 1.2, 1.02, (10.0, 245.0)

ExposureState = Literal["regulated", "too dark", "too bright", "no answer"]


def wanted_factor(lower: GreyLevels, upper: GreyLevels) -> float:
    """Return the factor of the light that the images want, of both cameras together."""
    mean, bright = max(1.0, math.sqrt(lower.mean * upper.mean)), max(lower.bright, upper.bright)
    factor = TARGET / mean
    if bright >= SATURATED:
        factor = min(factor, SATURATED_FACTOR)
    elif factor > 1:
        factor = min(factor, max(1.0, BRIGHT / max(bright, 1.0)))
    factor = max(factor, LEAST_MEAN / mean)  # lamps and windows are small: the rest shall be seen
    return min(max(factor, 1 / LARGEST_FACTOR), LARGEST_FACTOR)


class ExposureLaw:
    """Decides on steps by the levels of pairs; reads no clock."""

    def __init__(
        self, ranges: ExposureRanges, start: ExposureSetting, limit_us: float, flicker_us: float = 0.0
    ) -> None:
        """limit_us: of the exposure time. flicker_us: period of the lamps' light, 0: unknown.

        A longer exposure is a multiple of flicker_us, so that all images get the same light.
        """
        self._gains, self._flicker_us = ranges.gain, flicker_us
        self._of_camera, self._limit_us = ranges.exposure_us, limit_us
        self.setting = ExposureSetting(self._time(start.exposure_us), self._start_gain(start))
        self.state: ExposureState = "regulated"
        self.steps = 0
        self._next_ns: float = -float("inf")
        self._wait_s, self._direction = STEP_S, 0
        self._gain_step = 0 if self._gains is None else max(self._gains.step, self._gain_range // GAIN_STEPS)
        self._before: tuple[int, float] | None = None  # direction of the exposure time and mean, of the step before
        self._deaf = 0

    @property
    def _times(self) -> ValueRange:
        """The exposure times within the limit."""
        low = self._of_camera.low
        return ValueRange(low, max(low, min(self._of_camera.high, int(self._limit_us))), self._of_camera.step)

    def bound(self, limit_us: float) -> ExposureSetting | None:
        """Take another limit of the exposure time where it differs much; return the setting if that changes it."""
        if abs(limit_us - self._limit_us) <= NEW_LIMIT * self._limit_us:
            return None
        self._limit_us = limit_us
        if self.setting.exposure_us <= self._times.high:
            return None
        self.setting = ExposureSetting(self._time(limit_us), self.setting.gain)
        return self.setting

    def step(self, lower: GreyLevels, upper: GreyLevels, stamp_ns: int) -> ExposureSetting | None:
        """Return the setting from now on; None where it stays. The levels are those of images at the stamp."""
        if self.state == "no answer" or stamp_ns < self._next_ns:
            return None
        # 1. The factor on the light that is wanted, with a dead band.
        factor = wanted_factor(lower, upper)
        direction = (factor >= LEAST_UP) - (factor <= LEAST_DOWN)
        self.state = "regulated"
        if not direction:
            self._before, self._deaf = None, 0
            return None
        # 2. The setting that gives it; at the end of the range it stays.
        wanted = self._raised(factor) if direction > 0 else self._lowered(factor)
        if wanted == self.setting:
            self.state = "too dark" if direction > 0 else "too bright"
            return None
        # 3. A camera whose images do not follow is no longer regulated.
        if self._is_deaf(wanted, math.sqrt(lower.mean * upper.mean)):
            self.state = "no answer"
            return None
        # 4. Take the step, and wait until the images show it.
        self._note(direction)
        self._next_ns = stamp_ns + self._wait_s / S_PER_NS
        self.setting, self.steps = wanted, self.steps + 1
        return wanted

    @property
    def _gain_range(self) -> int:
        return 0 if self._gains is None else self._gains.high - self._gains.low

    def _start_gain(self, start: ExposureSetting) -> int | None:
        if self._gains is None:
            return None
        return self._gains.nearest(self._gains.low if start.gain is None else start.gain)

    def _time(self, wanted_us: float) -> int:
        """Return the nearest exposure time that the camera and the lamps allow."""
        time_us = self._times.nearest(wanted_us)
        if self._flicker_us and time_us > self._flicker_us:
            time_us = self._times.nearest(time_us // self._flicker_us * self._flicker_us)
        return time_us

    def _raised(self, factor: float) -> ExposureSetting:
        time_us = self._time(self.setting.exposure_us * factor)
        if time_us > self.setting.exposure_us or self._gains is None or self.setting.gain is None:
            return ExposureSetting(max(time_us, self.setting.exposure_us), self.setting.gain)
        return ExposureSetting(self.setting.exposure_us, self._gains.nearest(self.setting.gain + self._gain_step))

    def _lowered(self, factor: float) -> ExposureSetting:
        gain, time_us = self.setting.gain, self.setting.exposure_us
        has_gain = self._gains is not None and gain is not None and gain > self._gains.low
        if self._gains is not None and gain is not None and has_gain:
            gain = self._gains.nearest(gain - self._gain_step)
        if not has_gain or factor < VERY_BRIGHT:
            time_us = min(time_us, self._time(time_us * factor))
        return ExposureSetting(time_us, gain)

    def _note(self, direction: int) -> None:
        """Wait longer after a step against the one before, and make the steps of the gain smaller."""
        if direction == -self._direction:
            self._wait_s = min(2 * self._wait_s, LONGEST_STEP_S)
            if self._gains is not None:
                self._gain_step = max(self._gains.step, self._gain_step // 2)
        elif direction == self._direction:
            self._wait_s = STEP_S
        self._direction = direction

    def _is_deaf(self, wanted: ExposureSetting, mean: float) -> bool:
        """True if DEAF_STEPS steps of the exposure time in one direction left the images as bright as before."""
        factor = wanted.exposure_us / max(1, self.setting.exposure_us)
        direction = (factor >= DEAF_FACTOR) - (factor <= 1 / DEAF_FACTOR)
        before, self._before = self._before, (direction, mean) if direction else None
        if before is None or before[0] != direction or not SEEN_GREY[0] < mean < SEEN_GREY[1]:
            self._deaf = 0
            return False
        change = mean / max(before[1], 1.0)
        answered = (change if direction > 0 else 1 / change) >= ANSWER
        self._deaf = 0 if answered else self._deaf + 1
        return self._deaf >= DEAF_STEPS
