"""Cameras that are plugged in: their modes, their persistent names, and udev rules for names of our own."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.v4l2_exposure import ExposureControls
from drivers.cameras.v4l2_modes import Mode, list_modes
from drivers.cameras.v4l2_stream import device_error, query_capability
from drivers.errors import DriverError

RULES_FILE: Final = "/etc/udev/rules.d/70-omnid-cameras.rules"  # ID_PATH is set by 60-persistent-v4l.rules
_MEMORY_TO_MEMORY: Final = 0x8000 | 0x4000  # V4L2_CAP_VIDEO_M2M and V4L2_CAP_VIDEO_M2M_MPLANE: codecs
_MAX_DEVICES: Final = 256
_MAX_NAME: Final = 200  # characters of an entry of sysfs


@dataclass(frozen=True, slots=True)
class CaptureDevice:
    """One camera, as far as it could be queried."""

    node: str  # /dev/video0; may change when the camera is plugged in again
    name: str  # given to the node by the driver, often the product's
    driver: str
    bus: str  # V4L2's bus_info: where the camera is plugged in
    by_path: str  # persistent name of the port, "" if udev gave none
    by_id: str  # persistent name of the product and serial number, "" if udev gave none
    id_path: str  # udev's ID_PATH, "" if unknown
    modes: tuple[Mode, ...] = ()
    problem: str = ""  # reason why it could not be queried
    exposure: str = ""  # ranges of exposure time and gain as text, "" where they cannot be set


def capture_devices(root: Path = Path("/")) -> list[CaptureDevice]:
    """Return the capture devices of the system by number.

    root: replaces / by another tree with sys/class/video4linux and dev. A node that cannot be opened is listed with
    its problem; metadata nodes, outputs and codecs are left out.
    """
    nodes = sorted((root / "sys/class/video4linux").glob("video*"), key=lambda path: (len(path.name), path.name))
    found = [_device(root, path) for path in nodes[:_MAX_DEVICES] if _read(path / "index") in ("0", "")]
    return [device for device in found if device is not None]


def udev_rules(devices: Iterable[CaptureDevice]) -> Iterator[str]:
    """Yield a udev rule for each of the first two devices with a known port: /dev/omnid/lower and upper.

    Devices are matched by port, since two cameras of one model may differ in nothing else, and by the name of the
    node too where they share a port.
    """
    known = [device for device in devices if device.id_path]
    for device, camera in zip(known, ("lower", "upper"), strict=False):
        shared = sum(other.id_path == device.id_path for other in known) > 1
        name = f'ATTR{{name}}=="{device.name}", ' if shared else ""
        yield (
            f'SUBSYSTEM=="video4linux", ATTR{{index}}=="0", ENV{{ID_PATH}}=="{device.id_path}", {name}'
            f'SYMLINK+="omnid/{camera}"'
        )


def describe_device(device: CaptureDevice) -> Iterator[str]:
    """Yield the lines of a table with all properties of a device."""
    yield f"{device.node}  {device.name}  ({', '.join(filter(None, (device.driver, device.bus)))})"
    for name in filter(None, (device.by_path, device.by_id)):
        yield f"  {name}"
    if device.problem:
        yield f"  {device.problem}"
    for pixel_format in dict.fromkeys(mode.pixel_format for mode in device.modes):
        sizes = [mode for mode in device.modes if mode.pixel_format == pixel_format]
        yield f"  {pixel_format:<5}" + "; ".join(str(mode).partition(" ")[2] for mode in sizes)
    if device.modes:
        yield f"  {device.exposure or 'no exposure time to set'}"


def _device(root: Path, entry: Path) -> CaptureDevice | None:
    """Return the device of an entry in sysfs, None if it is not a capture device."""
    node = root / "dev" / entry.name
    by_path, by_id = (_link(root, folder, node) for folder in ("by-path", "by-id"))
    problem = ""
    try:
        found = _query(node)
        if found is None:
            return None
    except DriverError as error:
        found, problem = (_linked_name(entry / "device/driver"), "", (), ""), str(error)
    driver, bus, offered, exposure = found
    return CaptureDevice(
        _in(root, node),
        _read(entry / "name"),
        driver,
        bus,
        by_path,
        by_id,
        # udev's ID_PATH is a part of the link's name (60-persistent-v4l.rules).
        re.sub(r"-video-index\d+$", "", (by_path or _sibling_link(root, entry)).rpartition("/")[2]),
        offered,
        problem,
        exposure,
    )


def _query(node: Path) -> tuple[str, str, tuple[Mode, ...], str] | None:
    """Return driver, bus, modes and ranges of the exposure of a node, None if it is not a capture device.

    Raises DriverError where it cannot be opened or queried.
    """
    try:
        fd = os.open(node, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            found = query_capability(fd)
            if not found.device_caps & v4l2.CAP_VIDEO_CAPTURE or found.device_caps & _MEMORY_TO_MEMORY:
                return None
            return _text(found.driver), _text(found.bus_info), tuple(list_modes(fd)), describe_exposure(fd)
        finally:
            os.close(fd)
    except OSError as error:
        raise device_error(str(node), error) from error


def describe_exposure(fd: int) -> str:
    """Return the ranges of exposure time and gain of an open device; "" where it has no exposure time to set."""
    ranges = ExposureControls(fd).ranges
    if ranges is None:
        return ""
    times = f"exposure {ranges.exposure_us.low / 1000:g} to {ranges.exposure_us.high / 1000:g} ms"
    return times if ranges.gain is None else f"{times}, gain {ranges.gain.low} to {ranges.gain.high}"


def _link(root: Path, folder: str, node: Path) -> str:
    """Return the link in /dev/v4l/by-path or by-id to the node, "" without one.

    Newer versions of udev make two links for a port; the one with the older name is returned.
    """
    links = sorted((root / "dev/v4l" / folder).glob("*"))  # "-usb-" sorts before "-usbv2-"
    return next((_in(root, link) for link in links if link.resolve() == node.resolve()), "")


def _sibling_link(root: Path, entry: Path) -> str:
    """Return the by-path link of another node of the same port: udev links only one node of a port."""
    port = (entry / "device").resolve()
    siblings = [other for other in entry.parent.glob("video*") if (other / "device").resolve() == port]
    links = (_link(root, "by-path", root / "dev" / other.name) for other in siblings)
    return next(filter(None, links), "") if (entry / "device").exists() else ""


def _in(root: Path, path: Path) -> str:
    return "/" + path.relative_to(root).as_posix()


def _read(path: Path) -> str:
    try:
        return path.read_text("utf-8", "replace").strip()[:_MAX_NAME]
    except OSError:
        return ""


def _linked_name(path: Path) -> str:
    return path.resolve().name if path.exists() else ""


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", "replace")
