"""Checks of `omnid doctor`: cameras and motor, the rights of this user and of the service, the machine, rig and bus.

A check yields a finding for each fault, with what to do, or else one of level ok.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, Literal, NamedTuple

from calib.errors import CalibError
from calib.rig_file import read_rig
from drivers.cameras.v4l2_device import CaptureDevice, V4l2Settings
from drivers.errors import DriverError
from drivers.motors.serial_motor import motor_protocol
from omnid.config import RecordConfig
from omnid.controller.motor import SIMULATED, MotorSettings
from omnid.engine.process import PRIORITY_ADVICE, highest_priority
from omnid.errors import OmnidError
from omnid.transport.session import BusConfig, zenoh_config

Level = Literal["ok", "warning", "error"]
STATE: Final = Path("/var/lib/omnid")  # StateDirectory and working directory of the unit


class Finding(NamedTuple):
    """One line of the report: level, what was checked, what was found, what to do."""

    level: Level
    subject: str
    found: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.level:<8} {self.subject:<13} {self.found}" + (f"; {self.advice}" if self.advice else "")


def cameras(wanted: Mapping[str, V4l2Settings], known: list[CaptureDevice], root: Path) -> Iterator[Finding]:
    """Yield findings for each configured camera.

    known: the cameras that are connected. root: folder of dev and proc.
    """
    names = {name: root / settings.device.lstrip("/") for name, settings in wanted.items()}
    nodes = {(root / device.node.lstrip("/")).resolve(): device for device in known}
    for name, settings in wanted.items():
        subject, path = f"camera {name}", names[name]
        device = nodes.get(path.resolve())
        if not path.exists():
            connect = "connect the camera; `omnid cameras` lists the cameras and the names of their ports"
            yield Finding("error", subject, f"{settings.device} does not exist", connect)
        elif device is None:
            yield Finding("error", subject, f"{settings.device} is no camera", "choose one of `omnid cameras`")
        elif closed := access(subject, path):
            yield closed
        elif device.problem:
            yield Finding("error", subject, device.problem, "change section [cameras] of the configuration")
        else:
            yield Finding("ok", subject, f"{device.name} at {device.node}")


def motor(settings: MotorSettings, root: Path = Path("/")) -> Iterator[Finding]:
    """Check protocol and port: that it exists and may be opened; opening it would restart some boards."""
    subject, port, path = "motor", settings.port, root / settings.port.lstrip("/")
    try:
        motor_protocol(settings.protocol)
    except DriverError as fault:
        yield Finding("error", subject, str(fault), "set motor.protocol")
    if port in ("", SIMULATED):
        yield Finding("ok", subject, "simulated" if port else "none is configured: motor.port is empty")
    elif not path.exists():
        ports = "connect it; `ls -l /dev/serial/by-id` lists the ports, 90-omnid.rules gives it a name"
        yield Finding("error", subject, f"{port} does not exist", ports)
    elif not stat.S_ISCHR(path.stat().st_mode):
        yield Finding("error", subject, f"{port} is no serial port", "set motor.port")
    else:
        yield access(subject, path) or Finding("ok", subject, f"{settings.protocol} on {port}")


def access(subject: str, device: Path) -> Finding | None:
    """Return a finding if this user may not open the device."""
    if os.access(device, os.R_OK | os.W_OK):
        return None
    join = "`sudo usermod -aG video,dialout $USER`, then log in again; the service is in both groups"
    return Finding("error", subject, f"no permission for {device}", join)


def rights(priority: int) -> Finding:
    """Check that this user may have the real-time priority."""
    highest = highest_priority()
    allowed = f"priorities up to {highest} are allowed"
    if priority > highest:
        return Finding("warning", "real time", allowed, PRIORITY_ADVICE)
    return Finding("ok", "real time", allowed)


def disk(folder: Path, config: RecordConfig, bytes_per_s: float) -> Iterator[Finding]:
    """Check the space for recordings in the folder (or where it will be), and that the service may write there."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(existing).free
    usable = min(free - config.free_mb * 10**6, config.keep_mb * 10**6)
    where = f"{free / 1e9:.1f} GB free at {existing}"
    if usable <= 0:
        full = f"{where}: nothing is recorded below record.free_mb = {config.free_mb}"
        level: Level = "error" if config.enabled else "warning"
        yield Finding(level, "disk", full, "delete files, or change record.folder")
    else:
        hours = f"some {usable / bytes_per_s / 3600:.1f} h of JPEG (record.keep_mb, record.images_hz)"
        yield Finding("ok", "disk", f"{where}: the newest {usable / 1e9:.1f} GB of recordings are kept, {hours}")
    if not folder.is_relative_to(STATE):
        elsewhere = f"the service may write in {STATE} only, record.folder is {folder}"
        yield Finding("warning", "disk", elsewhere, f"`systemctl edit omnid`: [Service], ReadWritePaths={folder}")


def rig(path: Path, size_px: tuple[int, int], floor_m: float = 0.0) -> Iterator[Finding]:
    """Check that the rig can be read, is of images of this size (width, height), and states its height.

    floor_m: height of the floor in the base frame.
    """
    try:
        found = read_rig(path)
    except CalibError as fault:
        advice = "" if "omnid calibrate" in str(fault) else "create one with `omnid calibrate`"
        yield Finding("error", "rig", str(fault), advice)
        return
    for name, mounted in (("lower", found.lower), ("upper", found.upper)):
        if mounted.camera.size != size_px:
            (width, height), wanted = mounted.camera.size, "x".join(map(str, size_px))
            other = f"{path}: the {name} camera was calibrated with {width}x{height} px, [cameras] asks for {wanted}"
            yield Finding("error", "rig", other, "set cameras.width_px and height_px")
    if (height_m := found.height_m(floor_m)) is None:
        unknown = f"{path} does not state the height of the cameras: nothing is free"
        advice = "state it by `omnid calibrate drive LOG --only height`"
        yield Finding("warning", "rig", unknown, advice)
    else:
        good = f"{path}, {found.baseline_m:.3f} m between the viewpoints, {height_m:.3f} m above the floor"
        yield Finding("ok", "rig", good)


def bus(config: BusConfig) -> Finding:
    """Check the settings of the bus, and who may send commands."""
    try:
        zenoh_config(config)
    except OmnidError as fault:
        return Finding("error", "bus", str(fault), "the daemon does not start with these settings")
    local = re.compile(r"unixsock-stream/|[a-z-]+/(127\.|\[::1\]|localhost:)")
    endpoints = ", ".join(endpoint for endpoint in (*config.listen, *config.connect) if not local.match(endpoint))
    if endpoints and not config.config:
        advice = (
            "name a file with users in bus.config (omnid/transport/site.json5), or listen on tcp/127.0.0.1:7447 only"
        )
        return Finding("warning", "bus", f"anyone who reaches {endpoints} can drive the robot", advice)
    allowed = f"reachable at {endpoints}; who may command it is set by {config.config}"
    return Finding("ok", "bus", allowed if endpoints else "reachable from this machine only")
