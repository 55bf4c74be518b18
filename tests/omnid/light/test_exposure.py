"""Exposure: the law on simulated cameras, what counts of the images, requests, status."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from calib.panorama import fit_cylinder
from calib.rig import Rig
from drivers.cameras.camera_state import CameraExposure, CameraState, ExposureRanges, ExposureSetting, ValueRange
from drivers.frame import Camera
from omnid.config import CamerasConfig
from omnid.light.exposure import STEP_S, ExposureControl, ExposureLaw, GreyLevels, UsefulArea
from omnid.messages import FramePair
from omnid.transport.codec import OK, WARN, DiagnosticStatus
from omnid.transport.status_names import EXPOSURE, entry
from tests.simulation.recipes import mild_rig

LAW_RANGES = ExposureRanges(ValueRange(100, 200_000, 100), ValueRange(0, 100))
SCENE = np.random.default_rng(4).lognormal(0.0, 0.5, 400)  # radiances, mean about 1.1
START = ExposureSetting(5000, 0)
LAW_PERIOD_NS = 250_000_000  # between two pairs; the law takes a step at most once in STEP_S


class Sensor:
    """A camera: grey = 255 * (light * exposure * gain)^gamma, saturated; in decibels the gain 100 is a factor of 16."""

    def __init__(
        self, light: float, *, gamma: float = 1.0, linear_gain: bool = False, scene: np.ndarray = SCENE
    ) -> None:
        self.light, self._gamma, self._linear, self._scene = light, gamma, linear_gain, scene

    def levels(self, setting: ExposureSetting) -> GreyLevels:
        gain = setting.gain or 0
        factor = 1 + 15 * gain / 100 if self._linear else 16 ** (gain / 100)
        grey = 255 * (self.light * self._scene * setting.exposure_us / 10_000 * factor) ** self._gamma
        grey = np.clip(grey, 0, 255).round()
        return GreyLevels(float(grey.mean()), float(np.percentile(grey, 97)))


def run(law: ExposureLaw, sensor: Sensor, seconds: float, at_s: float = 0.0) -> list[tuple[float, ExposureSetting]]:
    """Return the steps with their times."""
    steps, level = [], sensor.levels(law.setting)
    for k in range(round(seconds * 1e9 / LAW_PERIOD_NS)):
        stamp_ns = round(at_s * 1e9) + k * LAW_PERIOD_NS
        wanted = law.step(level, level, stamp_ns)
        if wanted is not None:
            steps.append((stamp_ns * 1e-9, wanted))
            level = sensor.levels(wanted)
    return steps


@pytest.mark.parametrize("light", [0.02, 0.4, 8.0])
@pytest.mark.parametrize("sensor", [{}, {"gamma": 0.45}, {"linear_gain": True}])
def test_the_law_brings_scenes_into_the_middle_and_rests(light: float, sensor: dict[str, float]) -> None:
    camera, law = Sensor(light, **sensor), ExposureLaw(LAW_RANGES, START, 20_000)
    steps = run(law, camera, 20.0)
    level = camera.levels(law.setting)
    assert 60 < level.mean < 140 and level.bright < 250, (level, law.setting)
    assert law.state == "regulated" and all(at_s < 10 for at_s, _ in steps) and run(law, camera, 60.0, 20.0) == []
    assert all(b - a >= STEP_S for (a, _), (b, _) in pairwise(steps))


def test_the_exposure_rises_to_its_limit_before_the_gain_and_the_gain_falls_first() -> None:
    law = ExposureLaw(LAW_RANGES, START, 20_000)
    steps = [setting for _, setting in run(law, Sensor(0.05), 20.0)]
    first_gain = next(k for k, setting in enumerate(steps) if setting.gain)
    assert all(setting.exposure_us == 20_000 for setting in steps[first_gain:]) and steps[first_gain - 1].gain == 0
    brighter = [setting for _, setting in run(law, Sensor(0.1), 20.0, 60.0)]
    assert brighter and brighter[0].gain < steps[-1].gain and brighter[0].exposure_us == 20_000


def test_exposures_are_multiples_of_the_lamps_period() -> None:
    law = ExposureLaw(LAW_RANGES, START, 25_000, flicker_us=10_000.0)
    times = {setting.exposure_us for _, setting in run(law, Sensor(0.2), 20.0)}
    assert law.setting.exposure_us in (10_000, 20_000) and all(time % 10_000 == 0 or time < 10_000 for time in times)


def test_a_coarse_control_does_not_hunt() -> None:
    coarse = ExposureRanges(ValueRange(10_000, 50_000, 20_000))  # 10, 30, 50 ms: factors of 3
    law = ExposureLaw(coarse, ExposureSetting(10_000), 30_000)
    for light in np.geomspace(0.05, 2.0, 20):
        run(law, Sensor(light), 5.0)
        assert not run(law, Sensor(light), 60.0, 10.0), light


PERIOD_NS = 50_000_000
RANGES = ExposureRanges(ValueRange(100, 200_000, 100), ValueRange(0, 255))


@pytest.fixture(scope="module")
def rig() -> Rig:
    return mild_rig(3, 240)


@pytest.fixture(scope="module")
def area(rig: Rig) -> UsefulArea:
    return UsefulArea(rig, fit_cylinder(rig))


class LitCameras:
    """Two cameras under one light, which carry out requests as the driver does, and the control of their exposure."""

    def __init__(
        self,
        area: UsefulArea,
        light: float,
        config: CamerasConfig | None = None,
        ranges: tuple[ExposureRanges | None, ExposureRanges | None] = (RANGES, RANGES),
    ) -> None:
        names: tuple[Camera, Camera] = ("lower", "upper")
        self.light = light
        self.cameras = {
            name: CameraState(exposure=None if one is None else CameraExposure(one, in_force=ExposureSetting(5000, 0)))
            for name, one in zip(names, ranges, strict=True)
        }
        self.control = ExposureControl(area, config or CamerasConfig(), self.cameras)
        self.pairs, self.stamp_ns = 0, 0
        self.unequal = 0  # pairs of images with different exposures

    def run(self, seconds: float) -> DiagnosticStatus:
        for _ in range(round(seconds * 1e9 / PERIOD_NS)):
            self.pairs += 1
            self.stamp_ns += PERIOD_NS
            stamp_ns = self.stamp_ns
            settings = [
                ExposureSetting(5000, 0) if state.exposure is None else state.exposure.in_force
                for state in self.cameras.values()
            ]
            self.unequal += settings[0] != settings[1]
            grey = [self._grey(setting) for setting in settings]
            # The lower camera's thread is past this image already when the pair is measured, the upper one's is not.
            self._carry_out(self.cameras["lower"].exposure, stamp_ns)
            self.control.process(FramePair(self.pairs, stamp_ns, *grey))
            self._carry_out(self.cameras["upper"].exposure, stamp_ns)
        return entry(EXPOSURE, self.control.stats())

    def _grey(self, setting: ExposureSetting | None) -> np.ndarray:
        assert setting is not None
        factor = setting.exposure_us / 10_000 * 16 ** ((setting.gain or 0) / 255)
        return np.full((240, 240), min(255, round(255 * self.light * factor)), np.uint8)

    @staticmethod
    def _carry_out(exposure: CameraExposure | None, stamp_ns: int) -> None:
        request = None if exposure is None else exposure.request
        if exposure is not None and request is not None and stamp_ns >= request.after_ns and not exposure.problem:
            exposure.in_force = request.setting or ExposureSetting(5000, 0)


def test_both_cameras_get_the_same_values_between_two_pairs(area: UsefulArea) -> None:
    lit = LitCameras(area, 0.03)
    status = lit.run(15.0)
    assert status.level == OK and 60 < float(status.values["lower_grey"]) < 140, status
    assert float(status.values["exposure_ms"]) == 20.0 and int(status.values["gain"]) > 0
    assert int(status.values["steps"]) > 2 and lit.unequal == 0


def test_the_status_says_what_to_do_where_it_is_too_dark_or_too_bright(area: UsefulArea) -> None:
    lit = LitCameras(area, 0.0)
    status = lit.run(15.0)
    assert status.level == WARN and status.message.startswith("too dark") and "lights" in status.values["remedy"]
    lit.light = 1e4
    status = lit.run(25.0)
    assert status.level == WARN and status.message.startswith("too bright") and "shade" in status.values["remedy"]


@pytest.mark.parametrize(
    ("config", "ranges", "words"),
    [(CamerasConfig(auto_exposure="on"), (RANGES, RANGES), 'cameras.auto_exposure = "on"'),
     (CamerasConfig(), (RANGES, None), "no exposure time to set"),
     (CamerasConfig(), (RANGES, ExposureRanges(ValueRange(300_000, 400_000))), "no value in common")],
)  # fmt: skip
def test_the_exposure_is_left_to_the_cameras_and_the_status_says_why(
    area: UsefulArea, config: CamerasConfig, ranges: tuple[ExposureRanges | None, ExposureRanges | None], words: str
) -> None:
    lit = LitCameras(area, 0.5, config, ranges)
    status = lit.run(5.0)
    assert status.level == OK and words in status.message and "exposure_ms" not in status.values
    assert all(state.exposure is None or state.exposure.request is None for state in lit.cameras.values())


def test_cameras_that_refuse_an_exposure_get_their_own_back(area: UsefulArea) -> None:
    lit = LitCameras(area, 0.3)
    lit.run(1.0)
    exposure = lit.cameras["upper"].exposure
    assert exposure is not None
    exposure.problem = "it refused an exposure (Invalid argument)"
    assert "it refused an exposure" in lit.run(3.0).message
    for one in lit.cameras.values():
        assert one.exposure is not None and one.exposure.request is not None and one.exposure.request.setting is None


def test_levels_are_measured_where_the_panorama_is(rig: Rig, area: UsefulArea) -> None:
    pair = []
    for mounted in (rig.lower, rig.upper):
        image = np.full((240, 240), 255, np.uint8)
        v, u = np.mgrid[:240, :240]
        pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
        image.ravel()[mounted.visible.contains(pixels)] = 50
        pair.append(image)
    lower, upper = area.levels(FramePair(0, 0, pair[0], pair[1] // 2))
    assert (lower.mean, lower.bright) == (50, 50) and (upper.mean, upper.bright) == (25, 25)
