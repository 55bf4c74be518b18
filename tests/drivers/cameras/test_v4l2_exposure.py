"""Requests for exposure and gain on a device whose ioctls are answered by a table of controls, as uvcvideo does."""

from __future__ import annotations

import ctypes
import errno

import pytest

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.camera_exposure import (
    CameraExposure,
    ExposureRanges,
    ExposureRequest,
    ExposureSetting,
    ValueRange,
)
from drivers.cameras.v4l2_controls import (
    AUTO_EXPOSURE,
    AUTO_GAIN,
    EXPOSURE,
    EXPOSURE_MAY_SLOW,
    GAIN,
    apply_controls,
    list_controls,
    plan_controls,
)
from drivers.cameras.v4l2_devices import describe_exposure
from drivers.cameras.v4l2_exposure import ExposureControls
from drivers.cameras.v4l2_settings import V4l2Settings

INTEGER, BOOLEAN, MENU = v4l2.CONTROL_INTEGER, v4l2.CONTROL_BOOLEAN, v4l2.CONTROL_MENU
APERTURE_PRIORITY = 3
FD = 1000


class ControlTable:
    """The controls of a webcam behind the ioctl call; exposure and gain are refused while their mode is automatic."""

    def __init__(self) -> None:
        self.controls = {  # id: name, kind, low, high, step
            GAIN: ("Gain", INTEGER, 0, 255, 1),
            AUTO_GAIN: ("Gain, Automatic", BOOLEAN, 0, 1, 1),
            AUTO_EXPOSURE: ("Auto Exposure", MENU, 0, 3, 1),
            EXPOSURE: ("Exposure Time, Absolute", INTEGER, 3, 2047, 1),
            EXPOSURE_MAY_SLOW: ("Exposure, Dynamic Framerate", BOOLEAN, 0, 1, 1),
        }
        self.values = {GAIN: 64, AUTO_GAIN: 1, AUTO_EXPOSURE: APERTURE_PRIORITY, EXPOSURE: 156, EXPOSURE_MAY_SLOW: 1}
        self.written: list[tuple[int, int]] = []
        self.failing = 0  # errno of every write

    def call(self, fd: int, request: int, argument: ctypes.Structure) -> None:
        assert fd == FD
        if request == v4l2.QUERYCTRL:
            self._query(argument)
        elif request == v4l2.QUERYMENU:
            if argument.index not in (1, APERTURE_PRIORITY):
                raise OSError(errno.EINVAL, "no such entry")
        elif request == v4l2.G_CTRL:
            argument.value = self.values[argument.id]
        else:
            assert request == v4l2.S_CTRL
            self._write(argument.id, argument.value)

    def _query(self, entry: ctypes.Structure) -> None:
        after = entry.id & ~v4l2.NEXT_CONTROL
        following = sorted(control for control in self.controls if control > after)
        if not following:
            raise OSError(errno.EINVAL, "no more")
        entry.id = following[0]
        name, entry.type, entry.minimum, entry.maximum, entry.step = self.controls[following[0]]
        entry.name, entry.flags = name.encode(), 0

    def _write(self, control: int, value: int) -> None:
        automatic = {EXPOSURE: self.values[AUTO_EXPOSURE] != 1, GAIN: self.values.get(AUTO_GAIN) == 1}
        if self.failing or automatic.get(control):
            raise OSError(self.failing or errno.EACCES, "refused")
        self.values[control] = value
        self.written.append((control, value))


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> ControlTable:
    table = ControlTable()
    monkeypatch.setattr(v4l2, "call", table.call)
    return table


def exposure_of(controls: ExposureControls) -> CameraExposure:
    assert controls.ranges is not None
    return CameraExposure(controls.ranges, in_force=controls.read())


def test_reads_ranges_and_values(device: ControlTable) -> None:
    exposure = exposure_of(ExposureControls(FD))
    assert exposure.ranges == ExposureRanges(ValueRange(300, 204_700, 100), ValueRange(0, 255))
    assert exposure.in_force == ExposureSetting(15_600, 64) and device.written == []
    assert ExposureControls(FD, with_gain=False).ranges == ExposureRanges(ValueRange(300, 204_700, 100))


def test_takes_over_sets_once_when_due_and_gives_all_back(device: ControlTable) -> None:
    before, controls = dict(device.values), ExposureControls(FD)
    exposure = exposure_of(controls)
    controls.follow(exposure, 500)
    assert device.written == []
    exposure.request = ExposureRequest(ExposureSetting(8000, 10), after_ns=1000)
    controls.follow(exposure, 999)
    assert device.written == []
    controls.follow(exposure, 1000)
    assert device.written == [(AUTO_EXPOSURE, 1), (AUTO_GAIN, 0), (EXPOSURE, 80), (GAIN, 10)]
    assert exposure.in_force == ExposureSetting(8000, 10)
    controls.follow(exposure, 2000)
    assert len(device.written) == 4
    exposure.request = ExposureRequest(ExposureSetting(4000, 5), after_ns=0)
    controls.follow(exposure, 3000)
    assert device.written[4:] == [(EXPOSURE, 40), (GAIN, 5)]
    controls.release()
    assert {**device.values, EXPOSURE: before[EXPOSURE]} == before
    controls.release()
    assert device.written[6:] == [(GAIN, 64), (AUTO_GAIN, 1), (AUTO_EXPOSURE, APERTURE_PRIORITY)]


def test_a_request_for_none_gives_back_and_the_next_one_takes_over_again(device: ControlTable) -> None:
    controls = ExposureControls(FD, with_gain=False)
    exposure = exposure_of(controls)
    for setting, mode in ((ExposureSetting(8000), 1), (None, APERTURE_PRIORITY), (ExposureSetting(900), 1)):
        exposure.request = ExposureRequest(setting, after_ns=0)
        controls.follow(exposure, 1)
        assert device.values[AUTO_EXPOSURE] == mode and device.values[GAIN] == 64


def test_a_refusal_is_kept_and_ends_the_requests_a_lost_device_raises(device: ControlTable) -> None:
    controls = ExposureControls(FD)
    exposure = exposure_of(controls)
    exposure.request, device.failing = ExposureRequest(ExposureSetting(8000, 1), after_ns=0), errno.ERANGE
    controls.follow(exposure, 1)
    assert exposure.problem == "it refused an exposure (refused)"
    device.failing = 0
    exposure.request = ExposureRequest(ExposureSetting(8000, 2), after_ns=0)
    controls.follow(exposure, 2)
    assert device.values[GAIN] == 64
    lost = exposure_of(ExposureControls(FD))
    lost.request, device.failing = exposure.request, errno.ENODEV
    with pytest.raises(OSError, match="refused"):
        ExposureControls(FD).follow(lost, 1)


def test_a_camera_without_an_exposure_time_has_no_ranges(device: ControlTable) -> None:
    del device.controls[EXPOSURE]
    controls = ExposureControls(FD)
    assert controls.ranges is None and controls.read() is None and describe_exposure(FD) == ""


def test_ranges_in_the_list_of_cameras(device: ControlTable) -> None:
    assert describe_exposure(FD) == "exposure 0.3 to 204.7 ms, gain 0 to 255"
    del device.controls[GAIN]
    assert describe_exposure(FD) == "exposure 0.3 to 204.7 ms"


@pytest.mark.parametrize("missing", [(), (AUTO_EXPOSURE,), (AUTO_EXPOSURE, EXPOSURE_MAY_SLOW, EXPOSURE)])
def test_mode_rig_starts_with_the_cameras_own_at_a_fixed_rate(device: ControlTable, missing: tuple[int, ...]) -> None:
    device.values[AUTO_EXPOSURE] = 1
    for control in missing:
        del device.controls[control]
    plan = plan_controls(V4l2Settings("/dev/x", auto_exposure="rig"), list_controls(FD))
    apply_controls(FD, plan)
    expected = [(AUTO_EXPOSURE, APERTURE_PRIORITY), (EXPOSURE_MAY_SLOW, 0)]
    assert device.written == [one for one in expected if one[0] not in missing]


def test_a_fixed_exposure_goes_before_mode_rig(device: ControlTable) -> None:
    settings = V4l2Settings("/dev/x", auto_exposure="rig", exposure_us=5000)
    assert not settings.is_regulated and V4l2Settings("/dev/x", auto_exposure="rig").is_regulated
    apply_controls(FD, plan_controls(settings, list_controls(FD)))
    assert device.values[AUTO_EXPOSURE] == 1 and device.values[EXPOSURE] == 50
