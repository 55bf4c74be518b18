"""Checks of `omnid doctor`: cameras and motor, the rights of this user and of the service, the machine, rig and bus."""

from __future__ import annotations

import grp
import ipaddress
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
from omnid.controller.motor import SIMULATED
from omnid.controller.motor_settings import MotorSettings
from omnid.core.compiled import cache_folder, why_unusable
from omnid.engine.kernel_cache import why_no_code
from omnid.engine.realtime import LOCK_ADVICE, highest_priority, may_lock, priority_advice
from omnid.errors import OmnidError
from omnid.transport.bus_config import BusConfig, checked

Level = Literal["ok", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report: level, what was checked, what was found, what to do."""

    level: Level
    subject: str
    found: str
    advice: str = ""  # what to do

    def __str__(self) -> str:
        return f"{self.level:<8} {self.subject:<13} {self.found}" + (f"; {self.advice}" if self.advice else "")


def ok(subject: str, found: str) -> Finding:
    """Return a finding that needs nothing."""
    return Finding("ok", subject, found)


def warning(subject: str, found: str, advice: str) -> Finding:
    """Return a finding that a person should think about."""
    return Finding("warning", subject, found, advice)


def error(subject: str, found: str, advice: str = "") -> Finding:
    """Return a finding with which the daemon does not do its work."""
    return Finding("error", subject, found, advice)


def summary(findings: Sequence[Finding]) -> str:
    """Return the last line of the report."""
    errors, warnings = (sum(finding.level == level for finding in findings) for level in ("error", "warning"))
    if not errors and not warnings:
        return f"all {len(findings)} checks are ok"
    return f"{errors} errors, {warnings} warnings, {len(findings) - errors - warnings} ok"


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


_ENDPOINT = re.compile(r"[a-z-]+/\[?(?P<host>[^\]/]+?)\]?:\d{1,5}(?:[?#].*)?")
STATE: Final = Path("/var/lib/omnid")  # StateDirectory and working directory of the unit


def rights(priority: int, lock_memory: bool) -> Iterator[Finding]:
    """Check that this user may have the real-time priority, and may lock memory."""
    highest = highest_priority()
    if priority > highest:
        yield warning(
            "real time",
            f"priority {priority} is not allowed, this user may have {highest}; the unit sets LimitRTPRIO",
            priority_advice(priority),
        )
    else:
        yield ok("real time", f"priorities up to {highest} are allowed")
    if lock_memory and not may_lock():
        yield warning("memory", "this user may not lock memory; the unit sets LimitMEMLOCK", LOCK_ADVICE)
    else:
        yield ok("memory", "may be locked" if may_lock() else "not locked: realtime.lock_memory = false")


def disk(folder: Path, config: RecordConfig, bytes_per_s: float) -> Iterator[Finding]:
    """Check the space for recordings in the folder (or where it will be), and that the service may write there."""
    place = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(place).free
    room = min(free - config.free_mb * 10**6, config.keep_mb * 10**6)
    if room <= 0:
        yield Finding(
            "error" if config.enabled else "warning",
            "disk",
            f"{free / 1e9:.1f} GB free at {place}: nothing is recorded below record.free_mb = {config.free_mb}",
            "delete files, or change record.folder",
        )
    else:
        yield ok(
            "disk",
            f"{free / 1e9:.1f} GB free at {place}: the newest {room / 1e9:.1f} GB, about "
            f"{room / bytes_per_s / 3600:.1f} h, are kept of what is recorded",
        )
    if not folder.is_relative_to(STATE):
        yield warning(
            "disk",
            f"the service may write in {STATE} only, record.folder is {folder}",
            f"`systemctl edit omnid`: [Service], ReadWritePaths={folder}",
        )


def compiled_functions() -> Finding:
    """Check that functions can be compiled, and that they can be kept for the next start."""
    if problem := why_no_code():
        return error("compiled code", problem, "remove MemoryDenyWriteExecute= from the unit, or what else denies it")
    if reason := why_unusable(folder := cache_folder()):
        found = f"cannot be kept in {folder}: {reason}: every start takes half a minute longer"
        return warning("compiled code", found, "make that folder writable, or set OMNID_CACHE_DIR to another one")
    return ok("compiled code", f"kept in {folder}; the first start compiles it, which takes half a minute")


def rig(path: Path, size_px: tuple[int, int], floor_m: float = 0.0) -> Iterator[Finding]:
    """Check that the rig can be read, is of images of this size (width, height), states its height, and has masks.

    floor_m: height of the floor in the base frame.
    """
    try:
        found = read_rig(path)
    except CalibError as fault:
        advice = "" if "omnid calibrate" in str(fault) else "create one with `omnid calibrate`"
        yield error("rig", str(fault), advice)
        return
    cameras = {"lower": found.lower, "upper": found.upper}
    for name, mounted in cameras.items():
        width, height = mounted.camera.size
        if (width, height) != size_px:
            yield error(
                "rig",
                f"{path}: the {name} camera was calibrated with {width}x{height} px, "
                f"[cameras] asks for {size_px[0]}x{size_px[1]}",
                "set cameras.width_px and height_px",
            )
    height_m = found.height_m(floor_m)
    if height_m is None:
        yield warning(
            "rig",
            f"{path} does not state the height of the cameras: nothing is free until the images show the floor",
            "state it by `omnid calibrate drive LOG --only height`, with --ruler-m as a check",
        )
    bare = [name for name, mounted in cameras.items() if mounted.mask is None]
    if bare:
        yield warning(
            "rig",
            f"{path} has no mask for {' and '.join(bare)}, the rim is searched at each start",
            f"add [{bare[0]}.mask] with center, inner_px and outer_px",
        )
    else:
        yield ok(
            "rig",
            f"{path}, {found.baseline_m:.3f} m between the viewpoints"
            + ("" if height_m is None else f", {height_m:.3f} m above the floor"),
        )


def bus(config: BusConfig) -> Finding:
    """Check the settings of the bus, and who may send commands."""
    try:
        checked(config)
    except OmnidError as fault:
        return error("bus", str(fault), "the daemon does not start with these settings")
    endpoints = ", ".join(endpoint for endpoint in (*config.listen, *config.connect) if not _is_local(endpoint))
    if endpoints and not config.config:
        return warning(
            "bus",
            f"anyone who reaches {endpoints} can drive the robot",
            "name a file with users in bus.config (omnid/transport/site.json5), or listen on tcp/127.0.0.1:7447 only",
        )
    if endpoints:
        return ok("bus", f"reachable at {endpoints}; who may command it is said in {config.config}")
    return ok("bus", "reachable from this machine only")


def _is_local(endpoint: str) -> bool:
    parts = _ENDPOINT.fullmatch(endpoint)
    if parts is None:  # a socket in the file system
        return True
    with suppress(ValueError):
        return ipaddress.ip_address(parts["host"]).is_loopback
    return parts["host"] == "localhost"
