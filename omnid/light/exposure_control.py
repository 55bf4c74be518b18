"""Regulate the exposure of both live cameras by their pairs, and report in the status how bright they are."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Final

from drivers.cameras.camera_state import CameraExposure, CameraState, ExposureRanges, ExposureRequest, ExposureSetting
from drivers.frame import Camera
from omnid.camera_config import CamerasConfig
from omnid.core.nanoseconds import S_PER_NS
from omnid.light.exposure_law import STEP_S, ExposureLaw, ExposureState, GreyLevels, UsefulArea
from omnid.messages import FramePair
from omnid.transport.codec import OK, WARN, DiagnosticStatus
from omnid.transport.status_names import EXPOSURE, Key

PERIOD_SHARE: Final = 0.9  # Longest exposure by the images' period: the rest reads the image out.
MOST_STEPS: Final = 16  # Most steps between pairs of which the period is the first quartile.
AFTER_PERIODS: Final = 1.5  # from a pair to the request: both cameras then carry it out after the same pair
FLICKER_US: Final[Mapping[str, float]] = {"50": 1e6 / 100, "60": 1e6 / 120}  # lamps shine twice a period of the mains
DARK_GREY, WHITE_GREY = 25.0, 230.0  # means beyond which images of cameras that regulate themselves are reported
ADVICE: Final[Mapping[str, str]] = {
    "too dark": "switch lights on, drive more slowly and raise cameras.exposure_limit_ms, or clean the mirrors",
    "too bright": "shade the mirrors, or put a filter before the lenses",
    "no answer": 'set cameras.auto_exposure = "on", or a fixed cameras.exposure_us',
}
_WORDS: Final[Mapping[str, str]] = {
    "too dark": "too dark: exposure time and gain are at their limits",
    "too bright": "too bright: exposure time and gain are at their limits",
    "no answer": "the images stay as bright with another exposure: left to the cameras",
}
UNIT_MS: Final = 1e-3  # of 1 us


class ExposureControl:
    """A sink of the pairs of a live run.

    Only where the configuration says so and both cameras offer it, it makes requests; it measures in any case.
    """

    def __init__(self, area: UsefulArea, config: CamerasConfig, cameras: Mapping[Camera, CameraState]) -> None:
        self._area, self._config = area, config
        self._exposures = [state.exposure for state in cameras.values() if state.exposure is not None]
        self._left_to_cameras = _reason(config, cameras)
        self._law: ExposureLaw | None = None
        self._levels: tuple[GreyLevels, GreyLevels] | None = None  # of the newest measured pair
        self._next_ns: float = -float("inf")
        self._newest_ns = 0  # stamp of the newest pair
        self._steps_ns: deque[int] = deque(maxlen=MOST_STEPS)  # between pairs
        self._shortest_ns = float("inf")  # period: images that come more slowly later may do so for their exposure

    def process(self, pair: FramePair) -> None:
        """Measure a pair if it is due, and make a request where the law takes a step."""
        # 1. Measure the pair where it is due.
        if self._newest_ns and pair.stamp_ns > self._newest_ns:
            self._steps_ns.append(pair.stamp_ns - self._newest_ns)
            if len(self._steps_ns) == MOST_STEPS:
                self._shortest_ns = min(self._shortest_ns, self._quartile_ns)
        self._newest_ns = pair.stamp_ns
        if pair.stamp_ns < self._next_ns:
            return
        self._next_ns = pair.stamp_ns + STEP_S / S_PER_NS
        levels = self._area.levels(pair)
        self._levels = levels
        # 2. Leave it to the cameras where it cannot be regulated.
        if self._left_to_cameras or not self._steps_ns:
            return
        if any(exposure.problem for exposure in self._exposures):
            self._give_back(pair.stamp_ns)
            return
        # 3. Start, or take the law's step.
        if self._law is None:
            self._law = self._started()
            self._request(self._law.setting, pair.stamp_ns)
            return
        bounded = self._law.bound(self._limit_us)
        wanted = self._law.step(*levels, pair.stamp_ns) or bounded
        if wanted is not None:
            self._request(wanted, pair.stamp_ns)
        if self._law.state == "no answer":
            self._give_back(pair.stamp_ns)

    def status(self) -> DiagnosticStatus:
        """Return the entry: exposure, gain, grey levels; a warning if it is too dark or too bright."""
        levels, law = self._levels, self._law
        if levels is None:
            return DiagnosticStatus(EXPOSURE, OK, "no images yet", {})
        values = {f"{name}_grey": f"{level.mean:.0f}" for name, level in zip(("lower", "upper"), levels, strict=True)}
        values |= {
            f"{name}_bright_grey": f"{level.bright:.0f}" for name, level in zip(("lower", "upper"), levels, strict=True)
        }
        if law is not None and not self._left_to_cameras:
            values |= {"exposure_ms": f"{law.setting.exposure_us * UNIT_MS:.1f}", "steps": str(law.steps)}
            values |= {} if law.setting.gain is None else {"gain": str(law.setting.gain)}
        state, message = self._state(levels)
        if state in ADVICE:
            return DiagnosticStatus(EXPOSURE, WARN, message, values | {Key.REMEDY: ADVICE[state]})
        return DiagnosticStatus(EXPOSURE, OK, message, values)

    def _state(self, levels: tuple[GreyLevels, GreyLevels]) -> tuple[ExposureState, str]:
        """Return the state and its message."""
        if self._law is not None and (self._law.state == "no answer" or not self._left_to_cameras):
            return self._law.state, _WORDS.get(self._law.state, self._law.state)
        if min(level.mean for level in levels) < DARK_GREY:
            return "too dark", f"too dark; {self._left_to_cameras}"
        if max(level.mean for level in levels) > WHITE_GREY:
            return "too bright", f"too bright; {self._left_to_cameras}"
        return "regulated", self._left_to_cameras or "regulated"

    @property
    def _quartile_ns(self) -> float:
        """First quartile of the last steps: pairs are skipped, and stamps may burst."""
        return float(sorted(self._steps_ns)[len(self._steps_ns) // 4])

    @property
    def _period_ns(self) -> float:
        """Period of the images, the shortest that was seen over MOST_STEPS."""
        return min(self._shortest_ns, self._quartile_ns)

    @property
    def _limit_us(self) -> float:
        """Limit of the exposure time: longer ones would make the images come more slowly."""
        return min(self._config.exposure_limit_ms / UNIT_MS, PERIOD_SHARE * self._period_ns * 1e-3)

    def _started(self) -> ExposureLaw:
        """Return the law, which starts with what the lower camera has now."""
        limit_us = self._limit_us
        start = self._exposures[0].in_force or ExposureSetting(int(limit_us))
        return ExposureLaw(_ranges(self._exposures), start, limit_us, FLICKER_US.get(self._config.power_line, 0.0))

    def _request(self, setting: ExposureSetting | None, stamp_ns: int) -> None:
        after_ns = stamp_ns + int(AFTER_PERIODS * self._period_ns)
        for exposure in self._exposures:
            exposure.request = ExposureRequest(setting, after_ns)

    def _give_back(self, stamp_ns: int) -> None:
        """Let the cameras regulate themselves for the rest of the run."""
        problem = next((exposure.problem for exposure in self._exposures if exposure.problem), "")
        self._left_to_cameras = f"left to the cameras: {problem or 'they do not answer'}"
        self._request(None, stamp_ns)


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
