"""Checks of `omnid doctor`: cameras and motor, the rights of this user and of the service, the machine, rig and bus.

A check is a table of cases that may be wrong, each with what was found and what to do. Its findings are the cases that
apply, or else one of level ok.
"""

from __future__ import annotations

import grp
import os
import re
import shutil
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from calib.errors import CalibError
from calib.rig_file import read_rig
from drivers.cameras.v4l2_device import CaptureDevice, offered_image
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError
from drivers.motors.protocols.protocol_registry import motor_protocol
from omnid.config import RecordConfig
from omnid.controller.motor import SIMULATED, MotorSettings
from omnid.engine.realtime import LOCK_ADVICE, highest_priority, may_lock, priority_advice
from omnid.errors import OmnidError
from omnid.transport.bus_config import BusConfig
from omnid.transport.session import zenoh_config

Level = Literal["ok", "warning", "error"]
GROUPS: Final = ("video", "dialout")  # the unit's SupplementaryGroups
STATE: Final = Path("/var/lib/omnid")  # StateDirectory and working directory of the unit


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report: level, what was checked, what was found, what to do."""

    level: Level
    subject: str
    found: str
    advice: str = ""  # what to do

    def __str__(self) -> str:
        return f"{self.level:<8} {self.subject:<13} {self.found}" + (f"; {self.advice}" if self.advice else "")


# What is wrong where a condition holds: the condition, the level, what was found, what to do.
Case = tuple[object, Level, str, str]


def summary(findings: Sequence[Finding]) -> str:
    """Return the last line of the report."""
    errors, warnings = (sum(finding.level == level for finding in findings) for level in ("error", "warning"))
    if not errors and not warnings:
        return f"all {len(findings)} checks are ok"
    return f"{errors} errors, {warnings} warnings, {len(findings) - errors - warnings} ok"


def _applying(subject: str, *cases: Case, good: str = "") -> list[Finding]:
    """Return the findings of the cases that apply; if none does, a finding of level ok with the text good, if any."""
    found = [Finding(level, subject, what, advice) for applies, level, what, advice in cases if applies]
    return found or ([Finding("ok", subject, good)] if good else [])


def cameras(wanted: Mapping[str, V4l2Settings], known: list[CaptureDevice], root: Path) -> Iterator[Finding]:
    """Yield findings for each configured camera.

    known: the cameras that are connected. root: folder of dev and proc.
    """
    names = {name: root / settings.device.lstrip("/") for name, settings in wanted.items()}
    nodes = {(root / device.node.lstrip("/")).resolve(): device for device in known}
    for name, settings in wanted.items():
        subject, path = f"camera {name}", names[name]
        connect = "connect the camera; `omnid cameras` lists the cameras and the udev rule for this name"
        choose, device = "choose a device that `omnid cameras` lists", nodes.get(path.resolve())
        yield from _applying(
            subject,
            (not path.exists(), "error", f"{settings.device} does not exist", connect),
            (path.exists() and device is None, "error", f"{settings.device} is no camera", choose),
        )
        if device is not None:
            yield from _camera(subject, settings, device, path)
    if len({path.resolve() for path in names.values()}) < len(names):
        yield Finding(
            "error", "cameras", "both names lead to one device", "configure one for each, see `omnid cameras`"
        )


def _camera(subject: str, settings: V4l2Settings, device: CaptureDevice, path: Path) -> list[Finding]:
    """Return ok if a connected camera can be used as configured, else all reasons against it."""
    image, fault, problems = "in use, so that its image was not tried", device.problem, access(subject, path)
    if not fault and not problems:
        try:
            image = str(offered_image(settings) or image)
        except DriverError as error:
            fault = str(error)
    if fault:
        problems.append(Finding("error", subject, fault, "change section [cameras] of the configuration"))
    return problems or [Finding("ok", subject, f"{device.name} at {device.node}, {image}")]


def motor(settings: MotorSettings, root: Path = Path("/")) -> list[Finding]:
    """Check protocol and port: that it exists and may be opened; opening it would restart some boards."""
    subject, port, path = "motor", settings.port, root / settings.port.lstrip("/")
    found: list[Finding] = []
    try:
        motor_protocol(settings.protocol)
    except DriverError as fault:
        found.append(Finding("error", subject, str(fault), "set motor.protocol"))
    if port in ("", SIMULATED):
        good = "simulated" if port else "none is configured: motor.port is empty"
        return [*found, Finding("ok", subject, good)]
    ports = "connect it; `ls -l /dev/serial/by-id` lists the ports, 90-omnid.rules gives it a name"
    if not path.exists():
        return [*found, Finding("error", subject, f"{port} does not exist", ports)]
    if not stat.S_ISCHR(path.stat().st_mode):
        return [*found, Finding("error", subject, f"{port} is no serial port", "set motor.port")]
    return found + (access(subject, path) or [Finding("ok", subject, f"{settings.protocol} on {port}")])


def access(subject: str, device: Path) -> list[Finding]:
    """Return a finding if this user or the service may not open the device."""
    found = device.stat()
    group = str(found.st_gid)
    with suppress(KeyError):  # a group without a name
        group = grp.getgrgid(found.st_gid).gr_name
    is_open_to_service = group in GROUPS or (found.st_mode & stat.S_IROTH and found.st_mode & stat.S_IWOTH)
    closed = f"{device} is of group {group}, the service is in {' and '.join(GROUPS)}"
    rule = 'set GROUP="video" or GROUP="dialout" in its udev rule, see 90-omnid.rules'
    denied, join = (
        f"no permission for {device} of group {group}",
        f"`sudo usermod -aG {group} $USER`, then log in again",
    )
    is_denied = is_open_to_service and not os.access(device, os.R_OK | os.W_OK)
    return _applying(subject, (not is_open_to_service, "warning", closed, rule), (is_denied, "error", denied, join))


def rights(priority: int, lock_memory: bool) -> list[Finding]:
    """Check that this user may have the real-time priority, and may lock memory."""
    highest, locks = highest_priority(), may_lock()
    refused = f"priority {priority} is not allowed, this user may have {highest}; the unit sets LimitRTPRIO"
    unlocked = "this user may not lock memory; the unit sets LimitMEMLOCK"
    time: Case = priority > highest, "warning", refused, priority_advice(priority)
    memory: Case = lock_memory and not locks, "warning", unlocked, LOCK_ADVICE
    return [
        *_applying("real time", time, good=f"priorities up to {highest} are allowed"),
        *_applying("memory", memory, good="may be locked" if locks else "not locked: realtime.lock_memory = false"),
    ]


def disk(folder: Path, config: RecordConfig, bytes_per_s: float) -> list[Finding]:
    """Check the space for recordings in the folder (or where it will be), and that the service may write there."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(existing).free
    usable = min(free - config.free_mb * 10**6, config.keep_mb * 10**6)
    is_full, hours = usable <= 0, usable / bytes_per_s / 3600
    where = f"{free / 1e9:.1f} GB free at {existing}"
    kept = (
        f"{where}: the newest {usable / 1e9:.1f} GB of recordings are kept, some {hours:.1f} h of JPEG at "
        f"{bytes_per_s / 1e6:.1f} MB/s (record.keep_mb, record.images_hz)"
    )
    full = f"{where}: nothing is recorded below record.free_mb = {config.free_mb}"
    level: Level = "error" if config.enabled else "warning"
    elsewhere = f"the service may write in {STATE} only, record.folder is {folder}"
    allow = f"`systemctl edit omnid`: [Service], ReadWritePaths={folder}"
    return [
        *_applying("disk", (is_full, level, full, "delete files, or change record.folder"), good=kept),
        *_applying("disk", (not folder.is_relative_to(STATE), "warning", elsewhere, allow)),
    ]


def rig(path: Path, size_px: tuple[int, int], floor_m: float = 0.0) -> list[Finding]:
    """Check that the rig can be read, is of images of this size (width, height), and states its height.

    floor_m: height of the floor in the base frame.
    """
    try:
        found = read_rig(path)
    except CalibError as fault:
        advice = "" if "omnid calibrate" in str(fault) else "create one with `omnid calibrate`"
        return [Finding("error", "rig", str(fault), advice)]
    cameras, height_m = {"lower": found.lower, "upper": found.upper}, found.height_m(floor_m)
    sizes = {name: "x".join(map(str, mounted.camera.size)) for name, mounted in cameras.items()}
    wanted = "x".join(map(str, size_px))
    calibrated = f"{path}: the {{}} camera was calibrated with {{}} px, [cameras] asks for {wanted}"
    height = "" if height_m is None else f", {height_m:.3f} m above the floor"
    return _applying(
        "rig",
        *(
            (size != wanted, "error", calibrated.format(name, size), "set cameras.width_px and height_px")
            for name, size in sizes.items()
        ),
        (
            height_m is None,
            "warning",
            f"{path} does not state the height of the cameras: nothing is free until the images show the floor",
            "state it by `omnid calibrate drive LOG --only height`, with --ruler-m as a check",
        ),
        good=f"{path}, {found.baseline_m:.3f} m between the viewpoints{height}",
    )


def bus(config: BusConfig) -> Finding:
    """Check the settings of the bus, and who may send commands."""
    try:
        zenoh_config(config)
    except OmnidError as fault:
        return Finding("error", "bus", str(fault), "the daemon does not start with these settings")
    endpoints = ", ".join(endpoint for endpoint in (*config.listen, *config.connect) if not _is_local(endpoint))
    if endpoints and not config.config:
        advice = (
            "name a file with users in bus.config (omnid/transport/site.json5), or listen on tcp/127.0.0.1:7447 only"
        )
        return Finding("warning", "bus", f"anyone who reaches {endpoints} can drive the robot", advice)
    allowed = f"reachable at {endpoints}; who may command it is said in {config.config}"
    return Finding("ok", "bus", allowed if endpoints else "reachable from this machine only")


def _is_local(endpoint: str) -> bool:
    return re.match(r"unixsock-stream/|[a-z-]+/(127\.|\[::1\]|localhost:)", endpoint) is not None
