"""What the robot is joined to: the motor's controller, the network, the rig it was calibrated as."""

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
from omnid.doctor.devices import access, holders, is_ours
from omnid.doctor.finding import Finding
from omnid.errors import OmnidError
from omnid.transport.bus_config import BusConfig, checked

_TIMEOUT_S: Final = 2.0
_MOST_ENDPOINTS: Final = 8
_ENDPOINT = re.compile(r"(?P<protocol>[a-z-]+)/\[?(?P<host>[^\]/]+?)\]?:(?P<port>\d{1,5})(?:[?#].*)?")
_STREAMS = ("tcp", "tls", "ws")  # what a TCP connection can be tried with


def motor(port: str, root: Path = Path("/")) -> Iterator[Finding]:
    """Whether the controller's port is there, ours to open and free. It is not opened: some boards restart then."""
    subject, path = "motor", root / port.lstrip("/")
    if port in ("", SIMULATED):
        yield Finding("ok", subject, "simulated" if port else "none is configured: motor.port is empty")
    elif not path.exists():
        yield Finding("wrong", subject, f"{port} is not there",
                      "plug it in; `ls -l /dev/serial/by-id` lists what is there, 90-omnid.rules gives it a name")
    elif not stat.S_ISCHR(path.stat().st_mode):
        yield Finding("wrong", subject, f"{port} is no serial port", "set motor.port")
    else:
        others = [holder for holder in holders(path, root) if not is_ours(holder)]
        busy = [Finding("wrong", subject, f"{port} is in use by {', '.join(others)}", "end it; ModemManager lets "
                        "alone what 90-omnid.rules tells it to")] if others else []
        yield from [*access(subject, path), *busy] or [Finding("ok", subject, port)]


def rig(path: Path, size_px: tuple[int, int]) -> Iterator[Finding]:
    """Whether the rig can be read and is of images of this size (width, height), and whether it has masks."""
    try:
        found = read_rig(path)
    except CalibError as error:
        yield Finding("wrong", "rig", str(error), "`omnid calibrate` makes one")
        return
    cameras = {"lower": found.lower, "upper": found.upper}
    for name, mounted in cameras.items():
        width, height = mounted.camera.size
        if (width, height) != size_px:
            yield Finding("wrong", "rig", f"{path}: the {name} camera was calibrated with {width}x{height} px, "
                          f"[cameras] asks for {size_px[0]}x{size_px[1]}", "set cameras.width_px and height_px")
    bare = [name for name, mounted in cameras.items() if mounted.mask is None]
    if bare:
        yield Finding("warning", "rig", f"{path} has no mask for {' and '.join(bare)}, the rim is looked for at "
                      "each start", f"put [{bare[0]}.mask] with center, inner_px and outer_px into it")
    else:
        yield Finding("ok", "rig", f"{path}, {found.baseline_m:.3f} m between the viewpoints")


def bus(config: BusConfig) -> Iterator[Finding]:
    """Whether the settings can be used, whether strangers may command, and whether the routers answer."""
    try:
        checked(config)
    except OmnidError as error:
        yield Finding("wrong", "bus", str(error), "the daemon would not start with it")
    yield from _strangers(config)
    if not config.connect:
        yield Finding("ok", "router", "none is configured: bus.connect is empty")
    for endpoint in config.connect[:_MOST_ENDPOINTS]:
        yield _router(endpoint)


def _strangers(config: BusConfig) -> Iterator[Finding]:
    """Who may drive the robot from elsewhere."""
    open_ones = ", ".join(endpoint for endpoint in (*config.listen, *config.connect) if not _is_local(endpoint))
    obeyed = ", ".join((*config.command_names, *config.command_users))
    if open_ones and obeyed:
        yield Finding("ok", "bus", f"joined to others at {open_ones}; commands are taken from {obeyed} only")
    elif open_ones:
        yield Finding("warning", "bus", f"whoever reaches {open_ones} can drive the robot",
                      "name in bus.command_names or bus.command_users who may, or keep to tcp/127.0.0.1:7447")


def _router(endpoint: str) -> Finding:
    parts = _ENDPOINT.fullmatch(endpoint)
    if parts is None or parts["protocol"] not in _STREAMS:
        return Finding("ok", "router", f"{endpoint} is not tried: that can be done with {', '.join(_STREAMS)} only")
    try:
        socket.create_connection((parts["host"], int(parts["port"])), _TIMEOUT_S).close()
    except (OSError, OverflowError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        return Finding("warning", "router", f"{endpoint} does not answer: {reason}", "start it, or mend bus.connect; "
                       "the daemon goes on without, and the unit needs IPAddressAllow for it, see lan.conf")
    return Finding("ok", "router", f"{endpoint} answers")


def _is_local(endpoint: str) -> bool:
    parts = _ENDPOINT.fullmatch(endpoint)
    if parts is None:  # a socket in the file system
        return True
    with suppress(ValueError):
        return ipaddress.ip_address(parts["host"]).is_loopback
    return parts["host"] == "localhost"
