"""The law of the exposure on simulated cameras: a scene, the sensor's noise-free answer, saturation."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from drivers.cameras.camera_state import ExposureRanges, ExposureSetting, ValueRange
from omnid.light.exposure import LONGEST_STEP_S, STEP_S, TARGET, ExposureLaw, GreyLevels

RANGES = ExposureRanges(ValueRange(100, 200_000, 100), ValueRange(0, 100))
SCENE = np.random.default_rng(4).lognormal(0.0, 0.5, 400)  # radiances, mean about 1.1
START = ExposureSetting(5000, 0)
PERIOD_NS = 250_000_000  # of the pairs; more would be skipped


class Sensor:
    """A camera: grey = 255 * (light * exposure * gain)^gamma, saturated; decibels: gain 100 is a factor of 16."""

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
    for k in range(round(seconds * 1e9 / PERIOD_NS)):
        stamp_ns = round(at_s * 1e9) + k * PERIOD_NS
        wanted = law.step(level, level, stamp_ns)
        if wanted is not None:
            steps.append((stamp_ns * 1e-9, wanted))
            level = sensor.levels(wanted)
    return steps


@pytest.mark.parametrize("light", [0.02, 0.1, 0.4, 2.0, 8.0])
@pytest.mark.parametrize("sensor", [{}, {"gamma": 0.45}, {"linear_gain": True}])
def test_brings_scenes_into_the_middle_and_rests(light: float, sensor: dict[str, float]) -> None:
    camera, law = Sensor(light, **sensor), ExposureLaw(RANGES, START, 20_000)
    steps = run(law, camera, 20.0)
    level = camera.levels(law.setting)
    assert 60 < level.mean < 140 and level.bright < 250, (level, law.setting)
    assert law.state == "regulated" and all(at_s < 10 for at_s, _ in steps) and run(law, camera, 60.0, 20.0) == []
    assert all(b - a >= STEP_S for (a, _), (b, _) in pairwise(steps))


def test_raises_the_exposure_to_its_limit_before_the_gain_and_lowers_the_gain_first() -> None:
    law = ExposureLaw(RANGES, START, 20_000)
    steps = [setting for _, setting in run(law, Sensor(0.05), 20.0)]
    first_gain = next(k for k, setting in enumerate(steps) if setting.gain)
    assert all(setting.exposure_us == 20_000 for setting in steps[first_gain:]) and steps[first_gain - 1].gain == 0
    brighter = [setting for _, setting in run(law, Sensor(0.1), 20.0, 60.0)]
    assert brighter and brighter[0].gain < steps[-1].gain and brighter[0].exposure_us == 20_000


def test_never_leaves_its_limits_and_says_so() -> None:
    law = ExposureLaw(RANGES, START, 20_000)
    run(law, Sensor(0.001), 20.0)
    assert law.setting == ExposureSetting(20_000, 100) and law.state == "too dark"
    run(law, Sensor(1000.0), 30.0, 40.0)
    assert law.setting == ExposureSetting(100, 0) and law.state == "too bright"
    run(law, Sensor(0.5), 30.0, 80.0)
    assert law.state == "regulated"


def test_bright_lamps_do_not_saturate_but_may_not_darken_the_rest() -> None:
    some, many = (np.concatenate([SCENE, np.full(count, 8.0)]) for count in (20, 90))
    law = ExposureLaw(RANGES, START, 20_000)
    camera = Sensor(0.3, scene=some)
    run(law, camera, 30.0)
    assert 43 < camera.levels(law.setting).mean < TARGET * 1.3
    window = Sensor(0.3, scene=many)
    run(law, window, 30.0, 30.0)
    assert window.levels(law.setting).mean > 43


def test_multiples_of_the_lamps_period() -> None:
    law = ExposureLaw(RANGES, START, 25_000, flicker_us=10_000.0)
    times = {setting.exposure_us for _, setting in run(law, Sensor(0.2), 20.0)}
    assert law.setting.exposure_us in (10_000, 20_000) and all(time % 10_000 == 0 or time < 10_000 for time in times)


def test_a_coarse_control_does_not_hunt() -> None:
    coarse = ExposureRanges(ValueRange(10_000, 50_000, 20_000))  # 10, 30, 50 ms: factors of 3
    law = ExposureLaw(coarse, ExposureSetting(10_000), 30_000)
    steps = run(law, Sensor(0.22), 300.0)
    waits = [b - a for (a, _), (b, _) in pairwise(steps)]
    assert len(steps) < 20 and (not waits or max(waits) >= LONGEST_STEP_S)


def test_a_covered_lens_is_too_dark() -> None:
    covered = ExposureLaw(RANGES, ExposureSetting(100, 0), 20_000)
    run(covered, Sensor(0.0), 20.0)
    assert covered.state == "too dark"
