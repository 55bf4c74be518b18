"""The controls of a camera: what it offers, which are to be set for the settings, and the setting with a look back."""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError

_MAX_CONTROLS = 512
_MAX_MENU = 64
_KINDS: Final = (v4l2.CONTROL_INTEGER, v4l2.CONTROL_BOOLEAN, v4l2.CONTROL_MENU, v4l2.CONTROL_INTEGER_MENU)

# linux/v4l2-controls.h
GAIN: Final = 0x00980913
AUTO_GAIN: Final = 0x00980912
AUTO_WHITE_BALANCE: Final = 0x0098090C
POWER_LINE_FREQUENCY: Final = 0x00980918
AUTO_EXPOSURE: Final = 0x009A0901
EXPOSURE: Final = 0x009A0902  # in units of 100 us
EXPOSURE_MAY_SLOW: Final = 0x009A0903  # automatic exposure may lower the rate
FOCUS: Final = 0x009A090A
AUTO_FOCUS: Final = 0x009A090C
_MANUAL, _APERTURE_PRIORITY, _AUTO = 1, 3, 0  # enum v4l2_exposure_auto_type
_POWER_LINE: Final = {"off": 0, "50": 1, "60": 2, "auto": 3}
_NAMES: Final = {GAIN: "gain", AUTO_GAIN: "automatic gain", AUTO_WHITE_BALANCE: "automatic white balance",
                 POWER_LINE_FREQUENCY: "power line frequency", AUTO_EXPOSURE: "automatic exposure",
                 EXPOSURE: "exposure time", FOCUS: "focus", AUTO_FOCUS: "automatic focus"}


@dataclass(frozen=True, slots=True)
class CameraControl:
    """One control of a device, with its range."""

    id: int
    name: str  # the driver's, as `v4l2-ctl --list-ctrls` writes it: gain, exposure_time_absolute
    kind: int
    low: int
    high: int
    step: int = 1
    menu: Mapping[int, str] = field(default_factory=dict)  # what the numbers of a menu stand for

    def takes(self, value: int) -> bool:
        """Whether the value is in range."""
        if self.menu:
            return value in self.menu
        return self.low <= value <= self.high and (value - self.low) % max(1, self.step) == 0

    @property
    def range(self) -> str:
        """The range in words."""
        if self.menu:
            return ", ".join(f"{value} ({text})" for value, text in self.menu.items())
        return f"{self.low} to {self.high}" + (f" in steps of {self.step}" if self.step > 1 else "")


def controls(fd: int) -> dict[int, CameraControl]:
    """All controls of an open device that can be set and hold a number, by id."""
    found = {}
    for entry in _queried(fd):
        if entry.type in _KINDS and not entry.flags & (v4l2.CONTROL_DISABLED | v4l2.CONTROL_READ_ONLY):
            found[entry.id] = CameraControl(entry.id, _plain(entry.name), entry.type, entry.minimum, entry.maximum,
                                      entry.step, _menu(fd, entry))
    return found


def planned(settings: V4l2Settings, offered: Mapping[int, CameraControl]) -> list[tuple[CameraControl, int]]:
    """The controls to set with their values, automatics before what they govern.

    DriverError for a control that the device does not offer, or a value out of its range.
    """
    wanted = list(_automatics(settings, offered)) + list(_values(settings, offered))
    plan = [(_offered(control_id, offered), value) for control_id, value in wanted]
    plan += [_named(text, offered) for text in settings.controls]
    for control, value in plan:
        if not control.takes(value):
            raise DriverError(f"control {control.name}: {value} was asked, it takes {control.range}")
    return plan


def apply(fd: int, plan: list[tuple[CameraControl, int]]) -> None:
    """Sets the controls in their order, then reads them back; DriverError for what the device did not take."""
    for control, value in plan:
        try:
            v4l2.call(fd, v4l2.S_CTRL, v4l2.V4l2Control(control.id, value))
        except OSError as error:
            if error.errno in (errno.ENODEV, errno.EBUSY):
                raise
            raise DriverError(f"control {control.name}: the device refused {value} ({error.strerror}); "
                              f"it takes {control.range}, and some only while their automatic is off") from error
    for control, value in plan:
        found = value_of(fd, control.id)
        if found != value:
            raise DriverError(f"control {control.name}: {value} was set, the device stays at {found}; "
                              "set a value it keeps, or leave it as it is")


def value_of(fd: int, control_id: int) -> int:
    """The value in force."""
    control = v4l2.V4l2Control(control_id)
    v4l2.call(fd, v4l2.G_CTRL, control)
    return int(control.value)


def _automatics(settings: V4l2Settings, offered: Mapping[int, CameraControl]) -> Iterator[tuple[int, int]]:
    """Fixing a value implies that its automatic is off, where there is one."""
    if settings.auto_exposure != "keep" or settings.exposure_us:
        yield AUTO_EXPOSURE, _automatic_exposure(offered) if settings.auto_exposure == "on" else _MANUAL
        if EXPOSURE_MAY_SLOW in offered:
            yield EXPOSURE_MAY_SLOW, 0
    for control_id, switch, fixed in ((AUTO_GAIN, settings.auto_gain, settings.gain >= 0),
                                      (AUTO_WHITE_BALANCE, settings.auto_white_balance, False),
                                      (AUTO_FOCUS, settings.auto_focus, settings.focus >= 0)):
        if switch != "keep" or (fixed and control_id in offered):
            yield control_id, int(switch == "on")


def _automatic_exposure(offered: Mapping[int, CameraControl]) -> int:
    """USB cameras call it aperture priority, others automatic."""
    control = offered.get(AUTO_EXPOSURE)
    return _APERTURE_PRIORITY if control and _AUTO not in control.menu else _AUTO


def _values(settings: V4l2Settings, offered: Mapping[int, CameraControl]) -> Iterator[tuple[int, int]]:
    if settings.exposure_us:
        yield EXPOSURE, round(settings.exposure_us / 100)
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
    for _ in range(_MAX_CONTROLS):
        entry = v4l2.QueryControl(id=last | v4l2.NEXT_CONTROL)
        try:
            v4l2.call(fd, v4l2.QUERYCTRL, entry)
        except OSError:
            return
        yield entry
        last = entry.id


def _plain(name: bytes) -> str:
    """'Exposure Time, Absolute' as exposure_time_absolute, which is how v4l2-ctl writes it."""
    return re.sub(r"[^a-z0-9]+", "_", name.decode("utf-8", "replace").lower()).strip("_")


def _menu(fd: int, entry: v4l2.QueryControl) -> dict[int, str]:
    """The items of a menu; the driver leaves out those it does not have."""
    items = {}
    if entry.type in (v4l2.CONTROL_MENU, v4l2.CONTROL_INTEGER_MENU):
        for index in range(max(0, entry.minimum), min(entry.maximum, _MAX_MENU) + 1):
            item = v4l2.QueryMenu(id=entry.id, index=index)
            try:
                v4l2.call(fd, v4l2.QUERYMENU, item)
            except OSError:
                continue
            items[index] = (item.name.decode("utf-8", "replace") if entry.type == v4l2.CONTROL_MENU
                            else str(int.from_bytes(bytes(item)[8:16], "little", signed=True)))
    return items
