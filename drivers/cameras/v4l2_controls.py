"""Settings of a V4L2 camera, its controls, verified when it is opened, and its exposure, which a run may regulate."""

from __future__ import annotations

import errno
import re
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, NamedTuple

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.camera_state import (
    CameraExposure,
    ExposureRanges,
    ExposureSetting,
    ValueRange,
)
from drivers.cameras.v4l2_ioctl import ControlId, ExposureMode
from drivers.errors import DriverError

EXPOSURE_UNIT_US: Final = 100  # unit of V4L2_CID_EXPOSURE_ABSOLUTE
_POWER_LINE: Final = ("off", "50", "60", "auto")  # enum v4l2_power_line_frequency
_LOST: Final = (errno.ENODEV, errno.EBUSY)  # the camera is opened again, with its settings and its request


@dataclass(frozen=True, slots=True)
class V4l2Settings:
    """Device, image and controls. "keep" leaves a control as the camera has it."""

    device: str  # a path that persists when the camera is plugged in again: /dev/omnid/lower, /dev/v4l/by-path/...
    width_px: int = 1280
    height_px: int = 960
    rate_hz: float = 30.0  # 0: the device's own
    pixel_format: str = "auto"  # or a key of ENCODINGS of v4l2_device
    auto_exposure: str = "keep"  # keep, on, off or rig: set by a run, by the requests of CameraExposure, else as "on"
    exposure_us: int = 0  # above 0: fixed, automatic exposure off; in steps of 100
    gain: int = -1  # 0 and above: fixed, in the device's own units, automatic gain off
    power_line: str = "keep"  # keep, off, 50, 60 (Hz) or auto: suppresses the flicker of lamps
    controls: tuple[str, ...] = ()  # any others, as `v4l2-ctl --list-ctrls` names them: "focus_absolute=2"
    timeout_s: float = 2.0  # the device is opened again after this time without an image

    @property
    def is_regulated(self) -> bool:
        """True if a run sets the exposure by requests."""
        return self.auto_exposure == "rig" and not self.exposure_us


class CameraControl(NamedTuple):
    """One control of a device."""

    id: int
    name: str  # the driver's, as `v4l2-ctl --list-ctrls` writes it: gain, exposure_time_absolute
    range: ValueRange


def list_controls(fd: int) -> dict[int, CameraControl]:
    """Return the writable controls of an open device by id."""
    found, last = dict[int, CameraControl](), 0
    while True:
        # The driver returns the control after `last`, and an error after the last one; a faulty one may go in circles.
        entry = v4l2.QueryControl(id=last | v4l2.ControlFlag.NEXT_CTRL)
        try:
            v4l2.call(fd, "QUERYCTRL", entry)
        except OSError:
            return found
        if entry.id <= last:
            return found
        last = entry.id
        if not entry.flags & (v4l2.ControlFlag.DISABLED | v4l2.ControlFlag.READ_ONLY):
            # As v4l2-ctl writes it: exposure_time_absolute for 'Exposure Time, Absolute'.
            name = re.sub(r"[^a-z0-9]+", "_", entry.name.decode("utf-8", "replace").lower()).strip("_")
            found[last] = CameraControl(last, name, ValueRange(entry.minimum, entry.maximum, max(1, entry.step)))


def set_controls(fd: int, settings: V4l2Settings) -> None:
    """Set the controls of the settings, automatic modes before the values that they govern, and read each back.

    A fixed value switches its automatic mode off. Raises DriverError for a control that the device does not offer, and
    for a value that it does not take; OSError for a lost device.
    """
    offered = list_controls(fd)
    # 1. The wanted values: the setting, the control, the value and what may stand for it.
    wanted: list[tuple[str, int, tuple[int, ...]]] = []
    is_manual = settings.exposure_us > 0 or settings.auto_exposure == "off"
    if is_manual or settings.auto_exposure == "on" or (settings.is_regulated and ControlId.AUTO_EXPOSURE in offered):
        # An exposure that a run regulates is automatic until the run sends its first value.
        modes = (ExposureMode.MANUAL,) if is_manual else (ExposureMode.AUTO, ExposureMode.APERTURE_PRIORITY)
        wanted.append(("auto_exposure", ControlId.AUTO_EXPOSURE, modes))
    if settings.auto_exposure != "keep" or is_manual:
        wanted += [("", ControlId.EXPOSURE_AUTO_PRIORITY, (0,))] if ControlId.EXPOSURE_AUTO_PRIORITY in offered else []
    if is_manual and settings.exposure_us:
        wanted.append(("exposure_us", ControlId.EXPOSURE, (round(settings.exposure_us / EXPOSURE_UNIT_US),)))
    if (settings.gain >= 0 or settings.is_regulated) and ControlId.AUTO_GAIN in offered:
        wanted.append(("", ControlId.AUTO_GAIN, (int(settings.gain < 0),)))
    if settings.gain >= 0:
        wanted.append(("gain", ControlId.GAIN, (settings.gain,)))
    if settings.power_line != "keep":
        wanted.append(("power_line", ControlId.POWER_LINE_FREQUENCY, (_POWER_LINE.index(settings.power_line),)))
    # 2. Others by their names.
    ids = {control.name: control.id for control in offered.values()}
    for text in settings.controls:
        entry = re.fullmatch(r"(\w+) *= *(-?\d{1,10})", text)
        if entry is None:
            raise DriverError(f"controls has {text!r}; give entries such as 'gain=3'")
        wanted.append((f"controls: {entry[1]}", ids.get(entry[1], 0), (int(entry[2]),)))
    # 3. Set one after the other.
    for setting, control_id, values in wanted:
        if control_id not in offered:
            raise DriverError(f"the device has no control for cameras.{setting}. It has: {', '.join(ids) or 'none'}")
        refusal = _refusal(fd, offered[control_id], values[0])
        if refusal and values[1:]:
            refusal = _refusal(fd, offered[control_id], values[1])
        if refusal:
            raise DriverError(refusal)


def _refusal(fd: int, control: CameraControl, value: int) -> str:
    """Set a control and read it back; return why the device did not take the value, empty where it did."""
    try:
        _write(fd, control.id, value)
        found = _read(fd, control.id)
    except OSError as error:
        if error.errno in _LOST:
            raise
        return (
            f"control {control.name}: the device refused {value} ({error.strerror}); it accepts {control.range.low} to "
            f"{control.range.high}, and some only while their automatic mode is off"
        )
    return "" if found == value else f"control {control.name}: {value} was set, the device stays at {found}"


def _read(fd: int, control_id: int) -> int:
    control = v4l2.V4l2Control(control_id)
    v4l2.call(fd, "G_CTRL", control)
    return int(control.value)


def _write(fd: int, control_id: int, value: int) -> None:
    v4l2.call(fd, "S_CTRL", v4l2.V4l2Control(control_id, value))


def exposure_ranges(fd: int, settings: V4l2Settings) -> ExposureRanges | None:
    """Return the ranges of exposure time and gain that a run may set; None where the device has no exposure time.

    A gain that the settings fix is not set.
    """
    offered = list_controls(fd)
    if ControlId.EXPOSURE not in offered:
        return None
    times = offered[ControlId.EXPOSURE].range
    low, high, step = (value * EXPOSURE_UNIT_US for value in (times.low, times.high, times.step))
    gain = offered[ControlId.GAIN].range if ControlId.GAIN in offered and settings.gain < 0 else None
    return ExposureRanges(ValueRange(low, high, step), gain)


def exposure_in_force(fd: int, ranges: ExposureRanges) -> ExposureSetting | None:
    """Return exposure time and gain as the device reports them; None where it does not."""
    with suppress(OSError):
        gain = None if ranges.gain is None else _read(fd, ControlId.GAIN)
        return ExposureSetting(_read(fd, ControlId.EXPOSURE) * EXPOSURE_UNIT_US, gain)
    return None


def follow_request(fd: int, settings: V4l2Settings, exposure: CameraExposure, stamp_ns: int) -> None:
    """Carry out the newest request, if it is new and due after an image with that stamp.

    A value that the device refuses is kept as `exposure.problem`, and the camera's own exposure is in force again.
    Raises OSError for a lost device.
    """
    request = exposure.request
    if request is None or request is exposure.done or stamp_ns < request.after_ns or exposure.problem:
        return
    exposure.done = request
    try:
        if request.setting is None:
            set_controls(fd, settings)
        else:
            _set_exposure(fd, request.setting)
    except (OSError, DriverError) as error:
        if isinstance(error, OSError) and error.errno in _LOST:
            raise
        exposure.problem = f"it refused an exposure ({error})"
        with suppress(OSError, DriverError):
            set_controls(fd, settings)
    exposure.in_force = exposure_in_force(fd, exposure.ranges)


def _set_exposure(fd: int, setting: ExposureSetting) -> None:
    """Switch the automatic modes off, where the device has them, and set the values."""
    offered = list_controls(fd)
    values: list[tuple[int, int]] = (
        [(ControlId.AUTO_EXPOSURE, ExposureMode.MANUAL)] if ControlId.AUTO_EXPOSURE in offered else []
    )
    values += [(ControlId.AUTO_GAIN, 0)] if ControlId.AUTO_GAIN in offered and setting.gain is not None else []
    values.append((ControlId.EXPOSURE, round(setting.exposure_us / EXPOSURE_UNIT_US)))
    values += [(ControlId.GAIN, setting.gain)] if setting.gain is not None else []
    for control_id, value in values:
        _write(fd, control_id, value)
