"""Checks of the devices: cameras and motor controller, and the rights of this user and of the service."""

from __future__ import annotations

import grp
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from drivers.cameras.v4l2_device import CaptureDevice, offered_image
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError
from drivers.motors.protocols.protocol_registry import motor_protocol
from omnid.controller.motor import SIMULATED
from omnid.controller.motor_settings import MotorSettings
from omnid.doctor.finding import Finding, error, ok, warning

GROUPS: Final = ("video", "dialout")  # the unit's SupplementaryGroups
OWN_NAME: Final = "omnid"  # Name of the daemon's processes.


def cameras(wanted: Mapping[str, V4l2Settings], known: list[CaptureDevice], root: Path) -> Iterator[Finding]:
    """Yield findings for each configured camera.

    known: the cameras that are connected. root: folder of dev and proc.
    """
    for name, settings in wanted.items():
        subject, path = f"camera {name}", root / settings.device.lstrip("/")
        device = next((one for one in known if (root / one.node.lstrip("/")).resolve() == path.resolve()), None)
        if not path.exists():
            yield error(
                subject,
                f"{settings.device} does not exist",
                "connect the camera; `omnid cameras` lists the cameras and the udev rule for this name",
            )
        elif device is None:
            yield error(subject, f"{settings.device} is no camera", "choose a device that `omnid cameras` lists")
        else:
            yield from _camera(subject, settings, device, path, root)
    if len({(root / settings.device.lstrip("/")).resolve() for settings in wanted.values()}) < len(wanted):
        yield error("cameras", "both names lead to one device", "configure one for each, see `omnid cameras`")


def _camera(subject: str, settings: V4l2Settings, device: CaptureDevice, path: Path, root: Path) -> Iterator[Finding]:
    """Yield ok if a connected camera can be used as configured, else all reasons against it."""
    problems = list(access(subject, path))
    if others := holders(path, root):
        found = f"{settings.device} is open in {', '.join(others)}"
        problems.append(warning(subject, found, "end that program"))
    image = "in use, so that its image was not tried"
    try:
        if device.problem:
            raise DriverError(device.problem)
        if not problems:
            image = str(offered_image(settings) or image)
    except DriverError as fault:
        problems.append(error(subject, str(fault), "change section [cameras] of the configuration"))
    exposure = ""
    if settings.is_regulated:
        exposure = f", {device.exposure} set by omnid run" if device.exposure else ", exposure left to it"
    yield from problems or [ok(subject, f"{device.name} at {device.node}, {image}{exposure}")]


def motor(settings: MotorSettings, root: Path = Path("/")) -> Iterator[Finding]:
    """Check protocol and port: that it exists, may be opened and is free; opening it would restart some boards."""
    subject, port = "motor", settings.port
    try:
        motor_protocol(settings.protocol)
    except DriverError as fault:
        yield error(subject, str(fault), "set motor.protocol")
    path = root / port.lstrip("/")
    if port in ("", SIMULATED):
        yield ok(subject, "simulated" if port else "none is configured: motor.port is empty")
    elif not path.exists():
        yield error(
            subject,
            f"{port} does not exist",
            "connect it; `ls -l /dev/serial/by-id` lists the ports, 90-omnid.rules gives it a name",
        )
    elif not stat.S_ISCHR(path.stat().st_mode):
        yield error(subject, f"{port} is no serial port", "set motor.port")
    elif problems := [*access(subject, path), *_occupied(subject, port, path, root)]:
        yield from problems
    else:
        yield ok(subject, f"{settings.protocol} on {port}")


def _occupied(subject: str, port: str, path: Path, root: Path) -> Iterator[Finding]:
    if others := holders(path, root):
        advice = "end that program; 90-omnid.rules keeps ModemManager away from the port"
        yield error(subject, f"{port} is in use by {', '.join(others)}", advice)


def access(subject: str, device: Path) -> Iterator[Finding]:
    """Yield a finding if this user or the service may not open the device."""
    found = device.stat()
    group = str(found.st_gid)
    with suppress(KeyError):  # a group without a name
        group = grp.getgrgid(found.st_gid).gr_name
    if group not in GROUPS and found.st_mode & 0o006 != 0o006:
        yield warning(
            subject,
            f"{device} is of group {group}, the service is in {' and '.join(GROUPS)}",
            'set GROUP="video" or GROUP="dialout" in its udev rule, see 90-omnid.rules',
        )
    elif not os.access(device, os.R_OK | os.W_OK):
        yield error(
            subject,
            f"no permission for {device} of group {group}",
            f"`sudo usermod -aG {group} $USER`, then log in again",
        )


def holders(device: Path, root: Path = Path("/")) -> list[str]:
    """Return the programs but omnid that have the device open: "name (pid 12)"; without root those of this user."""
    target, found = str(device.resolve()), []
    for process in (root / "proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or belongs to another user
            name = (process / "comm").read_text("utf-8", "replace").strip()
            is_other = process.name != str(os.getpid()) and not name.startswith(OWN_NAME)
            if is_other and any(_target(entry) == target for entry in (process / "fd").iterdir()):
                found.append(f"{name} (pid {process.name})")
    return found


def _target(entry: Path) -> str:
    with suppress(OSError):
        return os.readlink(entry)
    return ""
