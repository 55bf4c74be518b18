"""Regulation of two cameras by their pairs: what counts of the images, requests, status."""

from __future__ import annotations

import numpy as np
import pytest

from calib.panorama import fit_cylinder
from calib.rig import Rig
from drivers.cameras.camera_state import CameraExposure, CameraState, ExposureRanges, ExposureSetting, ValueRange
from drivers.frame import Camera
from omnid.camera_config import CamerasConfig
from omnid.light.exposure import ExposureControl, UsefulArea
from omnid.messages import FramePair
from omnid.transport.codec import OK, WARN, DiagnosticStatus
from tests.simulation.recipes import mild_rig

PERIOD_NS = 50_000_000
RANGES = ExposureRanges(ValueRange(100, 200_000, 100), ValueRange(0, 255))


@pytest.fixture(scope="module")
def rig() -> Rig:
    return mild_rig(3, 240)


@pytest.fixture(scope="module")
def area(rig: Rig) -> UsefulArea:
    return UsefulArea(rig, fit_cylinder(rig))


class Robot:
    """Two cameras under one light, which carry out requests as the driver does, and their regulation."""

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

    def drive(self, seconds: float) -> DiagnosticStatus:
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
        return self.control.status()

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
    robot = Robot(area, 0.03)
    status = robot.drive(15.0)
    assert status.level == OK and 60 < float(status.values["lower_grey"]) < 140, status
    assert float(status.values["exposure_ms"]) == 20.0 and int(status.values["gain"]) > 0
    assert int(status.values["steps"]) > 2 and robot.unequal == 0


def test_the_exposure_stays_below_the_period_of_the_images(area: UsefulArea) -> None:
    status = Robot(area, 0.01, CamerasConfig(exposure_limit_ms=500.0, rate_hz=20.0)).drive(15.0)
    assert float(status.values["exposure_ms"]) == pytest.approx(45.0)


def test_says_when_it_is_too_dark_or_too_bright_and_what_to_do(area: UsefulArea) -> None:
    robot = Robot(area, 0.0)
    status = robot.drive(15.0)
    assert status.level == WARN and status.message.startswith("too dark") and "lights" in status.values["remedy"]
    robot.light = 1e4
    status = robot.drive(25.0)
    assert status.level == WARN and status.message.startswith("too bright") and "shade" in status.values["remedy"]


@pytest.mark.parametrize(
    ("config", "ranges", "words"),
    [(CamerasConfig(auto_exposure="on"), (RANGES, RANGES), 'cameras.auto_exposure = "on"'),
     (CamerasConfig(exposure_us=5000), (RANGES, RANGES), "fixed by cameras.exposure_us"),
     (CamerasConfig(), (RANGES, None), "no exposure time to set in the upper camera"),
     (CamerasConfig(), (RANGES, ExposureRanges(ValueRange(300_000, 400_000))), "no value in common")],
)  # fmt: skip
def test_leaves_the_exposure_to_the_cameras_and_says_why(
    area: UsefulArea, config: CamerasConfig, ranges: tuple[ExposureRanges | None, ExposureRanges | None], words: str
) -> None:
    robot = Robot(area, 0.5, config, ranges)
    status = robot.drive(5.0)
    assert status.level == OK and words in status.message and "exposure_ms" not in status.values
    assert all(state.exposure is None or state.exposure.request is None for state in robot.cameras.values())
    robot.light = 0.01
    status = robot.drive(5.0)
    assert status.level == WARN and status.message.startswith("too dark")


def test_gives_the_exposure_back_to_cameras_that_refuse_it(area: UsefulArea) -> None:
    robot = Robot(area, 0.3)
    robot.drive(1.0)
    exposure = robot.cameras["upper"].exposure
    assert exposure is not None
    exposure.problem = "it refused an exposure (Invalid argument)"
    assert "it refused an exposure" in robot.drive(3.0).message
    for one in robot.cameras.values():
        assert one.exposure is not None and one.exposure.request is not None and one.exposure.request.setting is None


def test_measures_where_the_panorama_is(rig: Rig, area: UsefulArea) -> None:
    pair = []
    for mounted in (rig.lower, rig.upper):
        image = np.full((240, 240), 255, np.uint8)
        v, u = np.mgrid[:240, :240]
        pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
        image.ravel()[mounted.visible.contains(pixels)] = 50
        pair.append(image)
    lower, upper = area.levels(FramePair(0, 0, pair[0], pair[1] // 2))
    assert (lower.mean, lower.bright) == (50, 50) and (upper.mean, upper.bright) == (25, 25)
