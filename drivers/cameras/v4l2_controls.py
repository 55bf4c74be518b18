"""The controls of a camera: planned and verified when it is opened, and its exposure, which a run sets by requests."""

from __future__ import annotations

import errno
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.camera_state import (
    CameraExposure,
    ExposureRanges,
    ExposureRequest,
    ExposureSetting,
    ValueRange,
)
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError

# linux/v4l2-controls.h: V4L2_CID_*
GAIN: Final = 0x00980913
AUTO_GAIN: Final = 0x00980912
POWER_LINE_FREQUENCY: Final = 0x00980918
AUTO_EXPOSURE: Final = 0x009A0901
EXPOSURE: Final = 0x009A0902
EXPOSURE_MAY_SLOW: Final = 0x009A0903  # V4L2_CID_EXPOSURE_AUTO_PRIORITY: automatic exposure may lower the rate
_NAMES: Final = {
    GAIN: "gain",
    AUTO_GAIN: "automatic gain",
    POWER_LINE_FREQUENCY: "power line frequency",
    AUTO_EXPOSURE: "automatic exposure",
    EXPOSURE: "exposure time",
}
EXPOSURE_UNIT_US: Final = 100  # unit of V4L2_CID_EXPOSURE_ABSOLUTE
AUTOMATIC, MANUAL_EXPOSURE, APERTURE_PRIORITY = 0, 1, 3  # enum v4l2_exposure_auto_type
_POWER_LINE: Final = {"off": 0, "50": 1, "60": 2, "auto": 3}  # enum v4l2_power_line_frequency
_NUMERIC: Final = (v4l2.CONTROL_INTEGER, v4l2.CONTROL_BOOLEAN, v4l2.CONTROL_MENU, v4l2.CONTROL_INTEGER_MENU)
_LOST: Final = (errno.ENODEV, errno.EBUSY)  # the camera is opened again, with its settings and its request


@dataclass(frozen=True, slots=True)
class CameraControl:
    """One control of a device."""

    id: int
    name: str  # the driver's, as `v4l2-ctl --list-ctrls` writes it: gain, exposure_time_absolute
    range: ValueRange
    has_automatic: bool = False  # of the exposure: it offers AUTOMATIC, unlike USB cameras


def list_controls(fd: int) -> dict[int, CameraControl]:
    """Return the writable numeric controls of an open device by id."""
    found, last = dict[int, CameraControl](), 0
    while True:
        # The driver returns the control after `last`, and an error after the last one; a faulty one may go in circles.
        entry = v4l2.QueryControl(id=last | v4l2.NEXT_CONTROL)
        try:
            v4l2.call(fd, v4l2.QUERYCTRL, entry)
        except OSError:
            return found
        if entry.id <= last:
            return found
        last, has_automatic = entry.id, False
        numeric = entry.type in _NUMERIC
        if not numeric or entry.flags & (v4l2.CONTROL_DISABLED | v4l2.CONTROL_READ_ONLY):
            continue
        if entry.id == AUTO_EXPOSURE:
            with suppress(OSError):  # the driver rejects what it does not offer
                v4l2.call(fd, v4l2.QUERYMENU, v4l2.QueryMenu(id=entry.id, index=AUTOMATIC))
                has_automatic = True
        # As v4l2-ctl writes it: exposure_time_absolute for 'Exposure Time, Absolute'.
        name = re.sub(r"[^a-z0-9]+", "_", entry.name.decode("utf-8", "replace").lower()).strip("_")
        values = ValueRange(entry.minimum, entry.maximum, max(1, entry.step))
        found[last] = CameraControl(last, name, values, has_automatic)


def plan_controls(settings: V4l2Settings, offered: Mapping[int, CameraControl]) -> list[tuple[CameraControl, int]]:
    """Return the controls to set with their values, automatic modes before the values that they govern.

    A fixed value switches its automatic mode off. Raises DriverError for a control that the device does not offer.
    """
    # 1. Those of the settings, by id.
    wanted: list[tuple[int, int]] = []
    if settings.auto_exposure != "keep" or settings.exposure_us:
        mode = MANUAL_EXPOSURE
        # An exposure that a run regulates is automatic until the run sends its first value.
        if settings.auto_exposure == "on" or settings.is_regulated:
            control = offered.get(AUTO_EXPOSURE)
            mode = APERTURE_PRIORITY if control and not control.has_automatic else AUTOMATIC
        if AUTO_EXPOSURE in offered or not settings.is_regulated:
            wanted.append((AUTO_EXPOSURE, mode))
        wanted += [(EXPOSURE_MAY_SLOW, 0)] if EXPOSURE_MAY_SLOW in offered else []
    if settings.auto_gain != "keep" or (settings.gain >= 0 and AUTO_GAIN in offered):
        wanted.append((AUTO_GAIN, int(settings.auto_gain == "on")))
    wanted += [(EXPOSURE, round(settings.exposure_us / EXPOSURE_UNIT_US))] if settings.exposure_us else []
    wanted += [(GAIN, settings.gain)] if settings.gain >= 0 else []
    wanted += [(POWER_LINE_FREQUENCY, _POWER_LINE[settings.power_line])] if settings.power_line != "keep" else []
    # 2. Others, by name.
    by_name = {control.name: control for control in offered.values()}
    all_names = f"It has: {', '.join(by_name) or 'none'}"
    for control_id, _ in wanted:
        if control_id not in offered:
            raise DriverError(f"the device has no control of its {_NAMES[control_id]}; leave it as it is. {all_names}")
    plan = [(offered[control_id], value) for control_id, value in wanted]
    for text in settings.controls:
        name, _, number = text.partition("=")
        if name.strip() not in by_name:
            raise DriverError(f"the device has no control '{name.strip()}'. {all_names}")
        plan.append((by_name[name.strip()], int(number)))
    return plan


def apply_controls(fd: int, plan: list[tuple[CameraControl, int]]) -> None:
    """Set the controls in order, then read them back; raise DriverError for a value that the device did not take."""
    for control, value in plan:
        try:
            _write(fd, control.id, value)
        except OSError as error:
            if error.errno in _LOST:
                raise
            raise DriverError(
                f"control {control.name}: the device refused {value} ({error.strerror}); it accepts "
                f"{control.range.low} to {control.range.high}, and some only while their automatic mode is off"
            ) from error
    for control, value in plan:
        found = _read(fd, control.id)
        if found != value:
            raise DriverError(
                f"control {control.name}: {value} was set, the device stays at {found}; "
                "set a value that it keeps, or leave it as it is"
            )


def _read(fd: int, control_id: int) -> int:
    control = v4l2.V4l2Control(control_id)
    v4l2.call(fd, v4l2.G_CTRL, control)
    return int(control.value)


def _write(fd: int, control_id: int, value: int) -> None:
    v4l2.call(fd, v4l2.S_CTRL, v4l2.V4l2Control(control_id, value))


class ExposureControls:
    """The controls of an open device.

    The automatic modes are switched off by the first request, and on again by the request for none and by `release`;
    a gain that was set before is set again.
    """

    def __init__(self, fd: int, *, with_gain: bool = True) -> None:
        """with_gain: False leaves the gain as it is, also where the device has one."""
        self._fd = fd
        offered = list_controls(fd)
        gain = offered.get(GAIN) if with_gain else None
        self._modes = [(AUTO_EXPOSURE, MANUAL_EXPOSURE)] if AUTO_EXPOSURE in offered else []
        self._modes += [(AUTO_GAIN, 0)] if AUTO_GAIN in offered and with_gain else []
        self._restored = [control for control, _ in self._modes] + ([GAIN] if gain else [])
        self.ranges: ExposureRanges | None = None  # None: the device has no exposure time to set
        if EXPOSURE in offered:
            times = offered[EXPOSURE].range
            low, high, step = (value * EXPOSURE_UNIT_US for value in (times.low, times.high, times.step))
            self.ranges = ExposureRanges(ValueRange(low, high, step), gain.range if gain else None)
        self._before: list[tuple[int, int]] = []  # control and value, while requests are in force
        self._done: ExposureRequest | None = None

    def read(self) -> ExposureSetting | None:
        """Return the values in force as the device reports them; None where it does not."""
        if self.ranges is None:
            return None
        with suppress(OSError):
            gain = None if self.ranges.gain is None else _read(self._fd, GAIN)
            return ExposureSetting(_read(self._fd, EXPOSURE) * EXPOSURE_UNIT_US, gain)
        return None

    def follow(self, exposure: CameraExposure, stamp_ns: int) -> None:
        """Carry out the newest request, if it is due after an image with that stamp.

        A value that the device refuses is kept as `exposure.problem`. Raises OSError for a lost device.
        """
        request = exposure.request
        if request is None or request is self._done or stamp_ns < request.after_ns or exposure.problem:
            return
        self._done = request
        try:
            if request.setting is None:
                self.release()
            else:
                self._set(request.setting)
            exposure.in_force = self.read()
        except OSError as error:
            if error.errno in _LOST:
                raise
            with suppress(OSError):
                self.release()
            exposure.problem = f"it refused an exposure ({error.strerror})"

    def release(self) -> None:
        """Give exposure and gain back to the automatic modes that were on; raise OSError for a lost device."""
        while self._before:
            _write(self._fd, *self._before.pop())

    def _set(self, setting: ExposureSetting) -> None:
        # 1. Switch the automatic modes off, and keep what `release` restores: the gain first, then the modes.
        if not self._before:
            self._before = [(control, _read(self._fd, control)) for control in self._restored]
            for control, value in self._modes:
                _write(self._fd, control, value)
        # 2. Set the values.
        _write(self._fd, EXPOSURE, round(setting.exposure_us / EXPOSURE_UNIT_US))
        if setting.gain is not None:
            _write(self._fd, GAIN, setting.gain)

    def __str__(self) -> str:
        """The ranges as text; "" where there is no exposure time to set."""
        if self.ranges is None:
            return ""
        times, gain = self.ranges.exposure_us, self.ranges.gain
        text = f"exposure {times.low / 1000:g} to {times.high / 1000:g} ms"
        return text if gain is None else f"{text}, gain {gain.low} to {gain.high}"
