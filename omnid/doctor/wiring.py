"""Checks of the connections: motor controller, rig file, bus."""

from __future__ import annotations

import ipaddress
import re
import socket
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from calib.errors import CalibError
from calib.rig_file import read_rig
from omnid.controller.motor import SIMULATED
from omnid.doctor.devices import access, holders
from omnid.doctor.finding import Finding
from omnid.errors import OmnidError
from omnid.transport.bus_config import BusConfig, checked

_TIMEOUT_S: Final = 2.0
_MAX_ENDPOINTS: Final = 8  # Most endpoints that are tried.
_ENDPOINT = re.compile(r"(?P<protocol>[a-z-]+)/\[?(?P<host>[^\]/]+?)\]?:(?P<port>\d{1,5})(?:[?#].*)?")
_STREAMS = ("tcp", "tls", "ws")  # protocols that are tried by a TCP connection


def motor(port: str, root: Path = Path("/")) -> Iterator[Finding]:
    """Check that the controller's port exists, may be opened and is free; opening it would restart some boards."""
    subject, path = "motor", root / port.lstrip("/")
    if port in ("", SIMULATED):
        yield Finding("ok", subject, "simulated" if port else "none is configured: motor.port is empty")
    elif not path.exists():
        yield Finding(
            "error",
            subject,
            f"{port} does not exist",
            "connect it; `ls -l /dev/serial/by-id` lists the ports, 90-omnid.rules gives it a name",
        )
    elif not stat.S_ISCHR(path.stat().st_mode):
        yield Finding("error", subject, f"{port} is no serial port", "set motor.port")
    else:
        problems = list(access(subject, path))
        others = holders(path, root)
        if others:
            problems.append(
                Finding(
                    "error",
                    subject,
                    f"{port} is in use by {', '.join(others)}",
                    "end that program; 90-omnid.rules keeps ModemManager away from the port",
                )
            )
        yield from problems or [Finding("ok", subject, port)]


def rig(path: Path, size_px: tuple[int, int], floor_m: float = 0.0) -> Iterator[Finding]:
    """Check that the rig can be read, is of images of this size (width, height), states its height, and has masks.

    floor_m: height of the floor in the base frame.
    """
    try:
        found = read_rig(path)
    except CalibError as error:
        advice = "" if "omnid calibrate" in str(error) else "create one with `omnid calibrate`"
        yield Finding("error", "rig", str(error), advice)
        return
    cameras = {"lower": found.lower, "upper": found.upper}
    for name, mounted in cameras.items():
        width, height = mounted.camera.size
        if (width, height) != size_px:
            yield Finding(
                "error",
                "rig",
                f"{path}: the {name} camera was calibrated with {width}x{height} px, "
                f"[cameras] asks for {size_px[0]}x{size_px[1]}",
                "set cameras.width_px and height_px",
            )
    height_m = found.height_m(floor_m)
    if height_m is None:
        yield Finding(
            "warning",
            "rig",
            f"{path} does not state the height of the cameras: nothing is free until the images show the floor",
            "state it by `omnid calibrate drive LOG --only height`, with --ruler-m as a check",
        )
    bare = [name for name, mounted in cameras.items() if mounted.mask is None]
    if bare:
        yield Finding(
            "warning",
            "rig",
            f"{path} has no mask for {' and '.join(bare)}, the rim is searched at each start",
            f"add [{bare[0]}.mask] with center, inner_px and outer_px",
        )
    else:
        yield Finding(
            "ok",
            "rig",
            f"{path}, {found.baseline_m:.3f} m between the viewpoints"
            + ("" if height_m is None else f", {height_m:.3f} m above the floor"),
        )


def bus(config: BusConfig) -> Iterator[Finding]:
    """Check the settings, who may send commands, and that the routers answer."""
    try:
        checked(config)
    except OmnidError as error:
        yield Finding("error", "bus", str(error), "the daemon does not start with these settings")
    yield from _remote_commands(config)
    if not config.connect:
        yield Finding("ok", "router", "none is configured: bus.connect is empty")
    for endpoint in config.connect[:_MAX_ENDPOINTS]:
        yield _router(endpoint)


def _remote_commands(config: BusConfig) -> Iterator[Finding]:
    """Yield a finding on who may command the robot over the network."""
    endpoints = ", ".join(endpoint for endpoint in (*config.listen, *config.connect) if not _is_local(endpoint))
    accepted = ", ".join((*config.command_names, *config.command_users))
    if endpoints and accepted:
        yield Finding("ok", "bus", f"reachable at {endpoints}; commands are accepted from {accepted} only")
    elif endpoints:
        yield Finding(
            "warning",
            "bus",
            f"anyone who reaches {endpoints} can drive the robot",
            "set bus.command_names or bus.command_users, or listen on tcp/127.0.0.1:7447 only",
        )


def _router(endpoint: str) -> Finding:
    parts = _ENDPOINT.fullmatch(endpoint)
    if parts is None or parts["protocol"] not in _STREAMS:
        return Finding("ok", "router", f"{endpoint} is not checked: only {', '.join(_STREAMS)} can be")
    try:
        socket.create_connection((parts["host"], int(parts["port"])), _TIMEOUT_S).close()
    except (OSError, OverflowError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        return Finding(
            "warning",
            "router",
            f"{endpoint} does not answer: {reason}",
            "start it, or correct "
            "bus.connect; the daemon runs without it; the unit needs IPAddressAllow for it, see lan.conf",
        )
    return Finding("ok", "router", f"{endpoint} answers")


def _is_local(endpoint: str) -> bool:
    parts = _ENDPOINT.fullmatch(endpoint)
    if parts is None:  # a socket in the file system
        return True
    with suppress(ValueError):
        return ipaddress.ip_address(parts["host"]).is_loopback
    return parts["host"] == "localhost"
