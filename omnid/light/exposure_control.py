"""Regulate the exposure of both live cameras by their pairs, and report in the status how bright they are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from drivers.cameras.camera_state import CameraExposure, CameraState, ExposureRanges, ExposureRequest, ExposureSetting
from drivers.frame import Camera
from omnid.camera_config import CamerasConfig
from omnid.core.nanoseconds import S_PER_NS
from omnid.light.exposure_law import STEP_S, ExposureLaw, GreyLevels, UsefulArea
from omnid.messages import FramePair
from omnid.transport.codec import OK, WARN, DiagnosticStatus
from omnid.transport.status_names import EXPOSURE, Key

USUAL_HZ: Final = 30.0  # rate of cameras that keep their own
PERIOD_SHARE: Final = 0.9  # Longest exposure by the images' period: the rest reads the image out.
AFTER_PERIODS: Final = 1.5  # from a pair to the request: both cameras then carry it out after the same pair
FLICKER_US: Final[Mapping[str, float]] = {"50": 1e6 / 100, "60": 1e6 / 120}  # lamps shine twice a period of the mains
DARK_GREY, WHITE_GREY = 25.0, 230.0  # means beyond which images of cameras that regulate themselves are reported
ADVICE: Final[Mapping[str, str]] = {
    "too dark": "switch lights on, drive more slowly and raise cameras.exposure_limit_ms, or clean the mirrors; where "
    'the images are bright enough, set cameras.auto_exposure = "on"',
    "too bright": "shade the mirrors, or put a filter before the lenses",
}


class ExposureControl:
    """A sink of the pairs of a live run.

    Only where the configuration says so and both cameras offer it, it makes requests; it measures in any case.
    """

    def __init__(self, area: UsefulArea, config: CamerasConfig, cameras: Mapping[Camera, CameraState]) -> None:
        self._area, self._config = area, config
        self._exposures = [state.exposure for state in cameras.values() if state.exposure is not None]
        self._left_to_cameras = _reason(config, cameras)
        self._period_ns = 1e9 / (config.rate_hz or USUAL_HZ)
        self._law: ExposureLaw | None = None
        self._levels: tuple[GreyLevels, GreyLevels] | None = None  # of the newest measured pair
        self._next_ns: float = -math.inf

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
        elif self._law is None:  # it starts with what the lower camera has now
            limit_us = min(1e3 * self._config.exposure_limit_ms, PERIOD_SHARE * self._period_ns * 1e-3)
            start = self._exposures[0].in_force or ExposureSetting(int(limit_us))
            flicker_us = FLICKER_US.get(self._config.power_line, 0.0)
            self._law = ExposureLaw(_ranges(self._exposures), start, limit_us, flicker_us)
            self._request(self._law.setting, pair.stamp_ns)
        elif (wanted := self._law.step(*self._levels, pair.stamp_ns)) is not None:
            self._request(wanted, pair.stamp_ns)

    def status(self) -> DiagnosticStatus:
        """Return the entry: exposure, gain, grey levels; a warning if it is too dark or too bright."""
        if self._levels is None:
            return DiagnosticStatus(EXPOSURE, OK, "no images yet", {})
        lower, upper = self._levels
        law = None if self._left_to_cameras else self._law
        values: dict[str, object] = {
            "lower_grey": round(lower.mean),
            "upper_grey": round(upper.mean),
            "lower_bright_grey": round(lower.bright),
            "upper_bright_grey": round(upper.bright),
        }
        if law is not None:
            gain = "" if law.setting.gain is None else law.setting.gain
            values |= {"exposure_ms": law.setting.exposure_us * 1e-3, "steps": law.steps, "gain": gain}
            state, reason = law.state, "exposure time and gain are at their limits"
        else:
            is_dark, is_white = min(lower.mean, upper.mean) < DARK_GREY, max(lower.mean, upper.mean) > WHITE_GREY
            state = "too dark" if is_dark else "too bright" if is_white else "regulated"
            reason = self._left_to_cameras
        if state in ADVICE:
            return DiagnosticStatus.of(EXPOSURE, WARN, f"{state}: {reason}", values | {Key.REMEDY: ADVICE[state]})
        return DiagnosticStatus.of(EXPOSURE, OK, self._left_to_cameras or state, values)

    def _request(self, setting: ExposureSetting | None, stamp_ns: int) -> None:
        """Ask both cameras for a setting; None: they regulate themselves."""
        for exposure in self._exposures:
            exposure.request = ExposureRequest(setting, stamp_ns + int(AFTER_PERIODS * self._period_ns))


def _reason(config: CamerasConfig, cameras: Mapping[Camera, CameraState]) -> str:
    """Return why the exposure is left to the cameras; empty where it is not."""
    if config.exposure_us:
        return "fixed by cameras.exposure_us"
    if config.auto_exposure != "rig":
        return f'left to the cameras: cameras.auto_exposure = "{config.auto_exposure}"'
    without = [name for name, state in cameras.items() if state.exposure is None]
    if without:
        return f"left to the cameras: no exposure time to set in the {' and the '.join(without)} camera"
    ranges = _ranges([state.exposure for state in cameras.values() if state.exposure is not None])
    if ranges.exposure_us.low > ranges.exposure_us.high:
        return "left to the cameras: their exposure times have no value in common"
    return ""


def _ranges(exposures: Sequence[CameraExposure]) -> ExposureRanges:
    """Return the ranges that both cameras have."""
    lower, upper = (exposure.ranges for exposure in exposures)
    gains = None if lower.gain is None or upper.gain is None else lower.gain.common(upper.gain)
    return ExposureRanges(lower.exposure_us.common(upper.exposure_us), gains)
