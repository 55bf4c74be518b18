"""Controls of a camera: planned in their order, refused where they are not accepted, and the exposure by requests."""

from __future__ import annotations

import errno
from typing import Any

import pytest

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.camera_state import (
    CameraExposure,
    ExposureRequest,
    ExposureSetting,
)
from drivers.cameras.v4l2_controls import (
    AUTO_EXPOSURE,
    AUTO_GAIN,
    EXPOSURE,
    EXPOSURE_MAY_SLOW,
    GAIN,
    ExposureControls,
    apply_controls,
    list_controls,
    plan_controls,
)
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError
from tests.drivers.cameras.fake_camera import APERTURE_PRIORITY, FakeCamera

FD = 1000


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> FakeCamera:
    made = FakeCamera()
    monkeypatch.setattr(v4l2, "call", made.call)
    return made


def plan(**fields: Any) -> list[tuple[str, int]]:
    settings = V4l2Settings("/dev/omnid/lower", **fields)
    return [(control.name, value) for control, value in plan_controls(settings, list_controls(FD))]


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({}, []),
        (
            {"exposure_us": 10_040, "gain": 15},
            [
                ("auto_exposure", 1),
                ("exposure_dynamic_framerate", 0),
                ("gain_automatic", 0),
                ("exposure_time_absolute", 100),
                ("gain", 15),
            ],
        ),
        ({"auto_exposure": "on"}, [("auto_exposure", 3), ("exposure_dynamic_framerate", 0)]),
        ({"auto_exposure": "rig"}, [("auto_exposure", 3), ("exposure_dynamic_framerate", 0)]),
        ({"controls": ("contrast = -3",)}, [("contrast", -3)]),
    ],
)
def test_automatic_modes_come_before_the_values_that_they_govern(
    camera: FakeCamera, fields: dict[str, Any], expected: list[tuple[str, int]]
) -> None:
    assert plan(**fields) == expected


def test_what_a_camera_lacks_is_needed_only_where_it_is_asked_for(camera: FakeCamera) -> None:
    camera.menu = (0, 1, 3)
    assert plan(auto_exposure="on")[0] == ("auto_exposure", 0)
    del camera.controls[AUTO_GAIN], camera.controls[AUTO_EXPOSURE], camera.controls[EXPOSURE_MAY_SLOW]
    assert plan(gain=15) == [("gain", 15)] and plan(auto_exposure="rig") == []
    for fields, name in (({"auto_gain": "off"}, "automatic gain"), ({"power_line": "50"}, "power line frequency")):
        with pytest.raises(DriverError, match=f"no control of its {name}"):
            plan(**fields)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"gain": 300}, "gain: 300 was requested, it accepts 0 to 255 in steps of 5"),
        ({"gain": 13}, "steps of 5"),
        ({"exposure_us": 40}, "exposure_time_absolute: 0 was requested, it accepts 3 to 2047"),
        ({"controls": ("auto_exposure=2",)}, "it accepts 1, 3"),
        ({"controls": ("contrast=65",)}, "-64 to 64"),
        ({"controls": ("sharpness=1",)}, "no control 'sharpness'. It has: contrast, gain_automatic"),
    ],
)
def test_refuses_what_the_camera_does_not_accept(camera: FakeCamera, fields: dict[str, Any], message: str) -> None:
    with pytest.raises(DriverError, match=message) as caught:
        plan(**fields)
    assert "\n" not in str(caught.value)


def test_controls_are_set_in_order_and_read_back(camera: FakeCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = V4l2Settings("/dev/x", auto_exposure="rig", exposure_us=5000)
    assert not settings.is_regulated and V4l2Settings("/dev/x", auto_exposure="rig").is_regulated
    apply_controls(FD, plan_controls(settings, list_controls(FD)))
    assert camera.values[AUTO_EXPOSURE] == 1 and camera.values[EXPOSURE] == 50
    contrast = plan_controls(V4l2Settings("/dev/x", controls=("contrast=3",)), list_controls(FD))
    monkeypatch.setattr(camera, "_set_control", lambda control: None)
    with pytest.raises(DriverError, match="contrast: 3 was set, the device stays at 1"):
        apply_controls(FD, contrast)
    camera.failing = errno.EIO
    with pytest.raises(DriverError, match=r"contrast: the device refused 3 \(Input/output error\)"):
        apply_controls(FD, contrast)
    camera.failing = errno.ENODEV
    with pytest.raises(OSError, match="No such device"):
        apply_controls(FD, contrast)


def exposure_of(controls: ExposureControls) -> CameraExposure:
    assert controls.ranges is not None
    return CameraExposure(controls.ranges, in_force=controls.read())


def test_takes_over_sets_once_when_due_and_gives_all_back(camera: FakeCamera) -> None:
    before, controls = dict(camera.values), ExposureControls(FD)
    exposure = exposure_of(controls)
    controls.follow(exposure, 500)
    exposure.request = ExposureRequest(ExposureSetting(8000, 10), after_ns=1000)
    controls.follow(exposure, 999)
    assert camera.written == []
    for stamp_ns in (1000, 2000):
        controls.follow(exposure, stamp_ns)
        assert camera.written == [(AUTO_EXPOSURE, 1), (AUTO_GAIN, 0), (EXPOSURE, 80), (GAIN, 10)]
        assert exposure.in_force == ExposureSetting(8000, 10)
    exposure.request = ExposureRequest(ExposureSetting(4000, 5), after_ns=0)
    controls.follow(exposure, 3000)
    assert camera.written[4:] == [(EXPOSURE, 40), (GAIN, 5)]
    controls.release()
    controls.release()
    assert camera.written[6:] == [(GAIN, 65), (AUTO_GAIN, 1), (AUTO_EXPOSURE, APERTURE_PRIORITY)]
    assert {**camera.values, EXPOSURE: before[EXPOSURE]} == before


def test_a_refusal_is_kept_and_ends_the_requests_a_lost_device_raises(camera: FakeCamera) -> None:
    controls = ExposureControls(FD)
    exposure = exposure_of(controls)
    exposure.request, camera.failing = ExposureRequest(ExposureSetting(8000, 1), after_ns=0), errno.ERANGE
    controls.follow(exposure, 1)
    assert exposure.problem == "it refused an exposure (Numerical result out of range)"
    camera.failing = 0
    exposure.request = ExposureRequest(ExposureSetting(8000, 2), after_ns=0)
    controls.follow(exposure, 2)
    assert camera.values[GAIN] == 65
    lost = exposure_of(ExposureControls(FD))
    lost.request, camera.failing = exposure.request, errno.ENODEV
    with pytest.raises(OSError, match="No such device"):
        ExposureControls(FD).follow(lost, 1)
