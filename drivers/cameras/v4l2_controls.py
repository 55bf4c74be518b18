"""The controls of a camera: list them, plan which to set, set them and verify them."""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError

_MAX_CONTROLS: Final = 512  # bounds the enumeration of a faulty driver
_MAX_MENU: Final = 64
_KINDS: Final = (v4l2.CONTROL_INTEGER, v4l2.CONTROL_BOOLEAN, v4l2.CONTROL_MENU, v4l2.CONTROL_INTEGER_MENU)

# linux/v4l2-controls.h: V4L2_CID_*
GAIN: Final = 0x00980913
AUTO_GAIN: Final = 0x00980912
AUTO_WHITE_BALANCE: Final = 0x0098090C
POWER_LINE_FREQUENCY: Final = 0x00980918
AUTO_EXPOSURE: Final = 0x009A0901
EXPOSURE: Final = 0x009A0902
EXPOSURE_MAY_SLOW: Final = 0x009A0903  # V4L2_CID_EXPOSURE_AUTO_PRIORITY: automatic exposure may lower the rate
FOCUS: Final = 0x009A090A
AUTO_FOCUS: Final = 0x009A090C
EXPOSURE_UNIT_US: Final = 100  # unit of V4L2_CID_EXPOSURE_ABSOLUTE
MANUAL_EXPOSURE: Final = 1  # enum v4l2_exposure_auto_type, with the next two
_APERTURE_PRIORITY, _AUTO = 3, 0
_POWER_LINE: Final = {"off": 0, "50": 1, "60": 2, "auto": 3}  # enum v4l2_power_line_frequency
_MENU_VALUE: Final = slice(8, 16)  # bytes of struct v4l2_querymenu: a 64-bit integer in the place of the name
_NAMES: Final = {
    GAIN: "gain",
    AUTO_GAIN: "automatic gain",
    AUTO_WHITE_BALANCE: "automatic white balance",
    POWER_LINE_FREQUENCY: "power line frequency",
    AUTO_EXPOSURE: "automatic exposure",
    EXPOSURE: "exposure time",
    FOCUS: "focus",
    AUTO_FOCUS: "automatic focus",
}


@dataclass(frozen=True, slots=True)
class CameraControl:
    """One control of a device, with its range."""

    id: int
    name: str  # the driver's, as `v4l2-ctl --list-ctrls` writes it: gain, exposure_time_absolute
    kind: int  # CONTROL_INTEGER, CONTROL_BOOLEAN, CONTROL_MENU or CONTROL_INTEGER_MENU
    low: int
    high: int
    step: int = 1
    menu: Mapping[int, str] = field(default_factory=dict)  # value -> name

    def accepts(self, value: int) -> bool:
        """True if the value is in range."""
        if self.menu:
            return value in self.menu
        return self.low <= value <= self.high and (value - self.low) % max(1, self.step) == 0

    @property
    def range(self) -> str:
        """The range as text."""
        if self.menu:
            return ", ".join(f"{value} ({text})" for value, text in self.menu.items())
        return f"{self.low} to {self.high}" + (f" in steps of {self.step}" if self.step > 1 else "")


def list_controls(fd: int) -> dict[int, CameraControl]:
    """Return the writable numeric controls of an open device by id."""
    found = {}
    for entry in _queried(fd):
        if entry.type in _KINDS and not entry.flags & (v4l2.CONTROL_DISABLED | v4l2.CONTROL_READ_ONLY):
            found[entry.id] = CameraControl(
                entry.id, _plain(entry.name), entry.type, entry.minimum, entry.maximum, entry.step, _menu(fd, entry)
            )
    return found


def plan_controls(settings: V4l2Settings, offered: Mapping[int, CameraControl]) -> list[tuple[CameraControl, int]]:
    """Return the controls to set with their values, automatic modes before the values that they govern.

    Raises DriverError for a control that the device does not offer, and for a value out of its range.
    """
    wanted = list(_automatic_modes(settings, offered)) + list(_fixed_values(settings))
    plan = [(_offered(control_id, offered), value) for control_id, value in wanted]
    plan += [_named(text, offered) for text in settings.controls]
    for control, value in plan:
        if not control.accepts(value):
            raise DriverError(f"control {control.name}: {value} was requested, it accepts {control.range}")
    return plan


def apply_controls(fd: int, plan: list[tuple[CameraControl, int]]) -> None:
    """Set the controls in order, then read them back; raise DriverError for a value that the device did not take."""
    for control, value in plan:
        try:
            v4l2.call(fd, v4l2.S_CTRL, v4l2.V4l2Control(control.id, value))
        except OSError as error:
            if error.errno in (errno.ENODEV, errno.EBUSY):
                raise
            raise DriverError(
                f"control {control.name}: the device refused {value} ({error.strerror}); "
                f"it accepts {control.range}, and some only while their automatic mode is off"
            ) from error
    for control, value in plan:
        found = read_control(fd, control.id)
        if found != value:
            raise DriverError(
                f"control {control.name}: {value} was set, the device stays at {found}; "
                "set a value that it keeps, or leave it as it is"
            )


def read_control(fd: int, control_id: int) -> int:
    """Return the value in force of a control."""
    control = v4l2.V4l2Control(control_id)
    v4l2.call(fd, v4l2.G_CTRL, control)
    return int(control.value)


def _automatic_modes(settings: V4l2Settings, offered: Mapping[int, CameraControl]) -> Iterator[tuple[int, int]]:
    """Yield (control id, value) of the automatic modes; a fixed value switches its automatic mode off."""
    if settings.auto_exposure != "keep" or settings.exposure_us:
        # An exposure that a run regulates is automatic until the run sends its first value.
        automatic = settings.auto_exposure == "on" or settings.is_regulated
        if AUTO_EXPOSURE in offered or not settings.is_regulated:
            yield AUTO_EXPOSURE, _automatic_exposure(offered) if automatic else MANUAL_EXPOSURE
        if EXPOSURE_MAY_SLOW in offered:
            yield EXPOSURE_MAY_SLOW, 0
    for control_id, switch, fixed in (
        (AUTO_GAIN, settings.auto_gain, settings.gain >= 0),
        (AUTO_WHITE_BALANCE, settings.auto_white_balance, False),
        (AUTO_FOCUS, settings.auto_focus, settings.focus >= 0),
    ):
        if switch != "keep" or (fixed and control_id in offered):
            yield control_id, int(switch == "on")


def _automatic_exposure(offered: Mapping[int, CameraControl]) -> int:
    """Return the menu entry for automatic exposure: aperture priority on USB cameras, automatic on others."""
    control = offered.get(AUTO_EXPOSURE)
    return _APERTURE_PRIORITY if control and _AUTO not in control.menu else _AUTO


def _fixed_values(settings: V4l2Settings) -> Iterator[tuple[int, int]]:
    if settings.exposure_us:
        yield EXPOSURE, round(settings.exposure_us / EXPOSURE_UNIT_US)
    if settings.gain >= 0:
        yield GAIN, settings.gain
    if settings.focus >= 0:
        yield FOCUS, settings.focus
    if settings.power_line != "keep":
        yield POWER_LINE_FREQUENCY, _POWER_LINE[settings.power_line]


def _offered(control_id: int, offered: Mapping[int, CameraControl]) -> CameraControl:
    if control_id not in offered:
        raise DriverError(f"the device has no control of its {_NAMES[control_id]}; leave it as it is. {_all(offered)}")
    return offered[control_id]


def _named(text: str, offered: Mapping[int, CameraControl]) -> tuple[CameraControl, int]:
    name, _, number = text.partition("=")
    for control in offered.values():
        if control.name == name.strip():
            return control, int(number)
    raise DriverError(f"the device has no control '{name.strip()}'. {_all(offered)}")


def _all(offered: Mapping[int, CameraControl]) -> str:
    return f"It has: {', '.join(control.name for control in offered.values()) or 'none'}"


def _queried(fd: int) -> Iterator[v4l2.QueryControl]:
    last = 0
    for _ in range(_MAX_CONTROLS):  # the driver returns the control after `last`, and an error after the last one
        entry = v4l2.QueryControl(id=last | v4l2.NEXT_CONTROL)
        try:
            v4l2.call(fd, v4l2.QUERYCTRL, entry)
        except OSError:
            return
        yield entry
        last = entry.id


def _plain(name: bytes) -> str:
    """Return the name as v4l2-ctl writes it: exposure_time_absolute for 'Exposure Time, Absolute'."""
    return re.sub(r"[^a-z0-9]+", "_", name.decode("utf-8", "replace").lower()).strip("_")


def _menu(fd: int, entry: v4l2.QueryControl) -> dict[int, str]:
    """Return value -> name of a menu; the driver rejects values that it does not offer."""
    items = {}
    if entry.type in (v4l2.CONTROL_MENU, v4l2.CONTROL_INTEGER_MENU):
        for index in range(max(0, entry.minimum), min(entry.maximum, _MAX_MENU) + 1):
            item = v4l2.QueryMenu(id=entry.id, index=index)
            try:
                v4l2.call(fd, v4l2.QUERYMENU, item)
            except OSError:
                continue
            items[index] = (
                item.name.decode("utf-8", "replace")
                if entry.type == v4l2.CONTROL_MENU
                else str(int.from_bytes(bytes(item)[_MENU_VALUE], "little", signed=True))
            )
    return items
