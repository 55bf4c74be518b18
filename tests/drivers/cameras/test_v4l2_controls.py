"""Controls of a camera: planned in their order, and refused where the camera does not accept them."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.cameras.v4l2_controls import (
    AUTO_EXPOSURE,
    AUTO_GAIN,
    EXPOSURE,
    EXPOSURE_MAY_SLOW,
    GAIN,
    POWER_LINE_FREQUENCY,
    CameraControl,
    plan_controls,
)
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError

MENU = {0: "Disabled", 1: "50 Hz", 2: "60 Hz"}


OFFERED = {
    control.id: control
    for control in (
        CameraControl(AUTO_EXPOSURE, "auto_exposure", 3, 0, 3, menu={1: "Manual Mode", 3: "Aperture Priority Mode"}),
        CameraControl(EXPOSURE, "exposure_time_absolute", 1, 3, 2047),
        CameraControl(EXPOSURE_MAY_SLOW, "exposure_dynamic_framerate", 2, 0, 1),
        CameraControl(GAIN, "gain", 1, 0, 100, 5),
        CameraControl(AUTO_GAIN, "gain_automatic", 2, 0, 1),
        CameraControl(POWER_LINE_FREQUENCY, "power_line_frequency", 3, 0, 2, menu=MENU),
        CameraControl(0x980901, "contrast", 1, -64, 64),
    )
}


def settings(**fields: Any) -> V4l2Settings:
    return V4l2Settings("/dev/omnid/lower", **fields)


def test_sets_no_control_by_default() -> None:
    assert plan_controls(settings(), OFFERED) == [] and plan_controls(settings(), {}) == []


def plan(**fields: Any) -> list[tuple[str, int]]:
    return [(control.name, value) for control, value in plan_controls(settings(**fields), OFFERED)]


def test_switches_the_automatic_mode_off_before_a_fixed_value() -> None:
    assert plan(exposure_us=10_040, gain=15) == [
        ("auto_exposure", 1), ("exposure_dynamic_framerate", 0), ("gain_automatic", 0),
        ("exposure_time_absolute", 100), ("gain", 15),
    ]  # fmt: skip


def test_uses_the_cameras_automatic_exposure_and_keeps_the_rate() -> None:
    assert plan(auto_exposure="on") == [("auto_exposure", 3), ("exposure_dynamic_framerate", 0)]
    full = {
        AUTO_EXPOSURE: CameraControl(AUTO_EXPOSURE, "auto_exposure", 3, 0, 3, menu={0: "Auto", 1: "Manual", 3: "A"})
    }
    assert plan_controls(settings(auto_exposure="on"), full) == [(full[AUTO_EXPOSURE], 0)]


def test_a_fixed_gain_needs_no_automatic_mode_but_switching_it_does() -> None:
    only_gain = {GAIN: OFFERED[GAIN]}
    assert plan_controls(settings(gain=15), only_gain) == [(OFFERED[GAIN], 15)]
    with pytest.raises(DriverError, match="no control of its automatic gain"):
        plan_controls(settings(auto_gain="off"), only_gain)


def test_sets_other_controls_by_name() -> None:
    assert plan(power_line="50", controls=("contrast=-3",)) == [("power_line_frequency", 1), ("contrast", -3)]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"gain": 101}, "gain: 101 was requested, it accepts 0 to 100 in steps of 5"),
        ({"gain": 13}, "steps of 5"),
        ({"exposure_us": 40}, "exposure_time_absolute: 0 was requested, it accepts 3 to 2047"),
        ({"power_line": "auto"}, r"0 \(Disabled\), 1 \(50 Hz\), 2 \(60 Hz\)"),
        ({"focus": 3}, "no control of its focus.*It has: auto_exposure, exposure"),
        ({"auto_white_balance": "on"}, "automatic white balance"),
        ({"controls": ("contrast=65",)}, "-64 to 64"),
        ({"controls": ("sharpness=1",)}, "no control 'sharpness'. It has: auto_exposure"),
    ],
)
def test_refuses_controls_that_the_camera_does_not_accept(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(DriverError, match=message) as caught:
        plan_controls(settings(**fields), OFFERED)
    assert "\n" not in str(caught.value)
