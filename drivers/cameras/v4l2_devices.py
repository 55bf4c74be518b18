"""Which cameras are plugged in, what they offer, what to call them, and the udev rule for names of our own."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.v4l2_modes import Mode, modes
from drivers.cameras.v4l2_stream import capability, explained
from drivers.errors import DriverError

RULES_FILE: Final = "/etc/udev/rules.d/70-omnid-cameras.rules"  # ID_PATH is there after 60-persistent-v4l.rules
_MEMORY_TO_MEMORY = 0x8000 | 0x4000  # V4L2_CAP_VIDEO_M2M and its multi-planar kin: codecs
_MAX_DEVICES = 256


@dataclass(frozen=True, slots=True)
class CaptureDevice:
    """One camera, as far as it let itself be asked."""

    node: str  # /dev/video0; another one after the next plugging
    name: str  # the driver's for the node, often the product's
    driver: str
    bus: str  # where it is plugged in, as the driver says it
    by_path: str  # stable name of the port, "" if udev gave none
    by_id: str  # stable name of the product and serial number, "" if udev gave none
    id_path: str  # udev's ID_PATH, "" if unknown
    modes: tuple[Mode, ...] = ()
    problem: str = ""  # why it could not be asked


def capture_devices(root: Path = Path("/")) -> list[CaptureDevice]:
    """The capture devices of the system, or of a tree that has the same sys/class/video4linux and dev, by number.

    A node that cannot be opened is listed with its problem; metadata nodes, outputs and codecs are left out.
    """
    nodes = sorted((root / "sys/class/video4linux").glob("video*"), key=lambda path: (len(path.name), path.name))
    found = [_device(root, path) for path in nodes[:_MAX_DEVICES] if _read(path / "index") in ("0", "")]
    return [device for device in found if device is not None]


def udev_rules(devices: Iterable[CaptureDevice]) -> Iterator[str]:
    """A line for each of the first two devices whose port is known, to call them /dev/omnid/lower and upper.

    By the port, since two cameras of one kind differ in nothing else; by the node's name too where they share a port.
    """
    known = [device for device in devices if device.id_path]
    for device, camera in zip(known, ("lower", "upper"), strict=False):
        shared = sum(other.id_path == device.id_path for other in known) > 1
        name = f'ATTR{{name}}=="{device.name}", ' if shared else ""
        yield (f'SUBSYSTEM=="video4linux", ATTR{{index}}=="0", ENV{{ID_PATH}}=="{device.id_path}", {name}'
               f'SYMLINK+="omnid/{camera}"')


def described(device: CaptureDevice) -> Iterator[str]:
    """The lines of a table that say everything about a device."""
    yield f"{device.node}  {device.name}  ({', '.join(filter(None, (device.driver, device.bus)))})"
    for name in filter(None, (device.by_path, device.by_id)):
        yield f"  {name}"
    if device.problem:
        yield f"  {device.problem}"
    for pixel_format in dict.fromkeys(mode.pixel_format for mode in device.modes):
        sizes = [mode for mode in device.modes if mode.pixel_format == pixel_format]
        yield f"  {pixel_format:<5}" + "; ".join(str(mode).partition(" ")[2] for mode in sizes)


def _device(root: Path, entry: Path) -> CaptureDevice | None:
    """The device of an entry in sysfs; None if it captures nothing."""
    node = root / "dev" / entry.name
    by_path, by_id = (_link(root, folder, node) for folder in ("by-path", "by-id"))
    problem = ""
    try:
        asked = _asked(node)
        if asked is None:
            return None
    except DriverError as error:
        asked, problem = (_linked_name(entry / "device/driver"), "", ()), str(error)
    driver, bus, offered = asked
    return CaptureDevice(_in(root, node), _read(entry / "name"), driver, bus, by_path, by_id,
                         _id_path(by_path or _sibling_link(root, entry)), offered, problem)


def _asked(node: Path) -> tuple[str, str, tuple[Mode, ...]] | None:
    """Driver, bus and modes of a node, None if it captures nothing; DriverError where it cannot be asked."""
    try:
        fd = os.open(node, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            found = capability(fd)
            if not found.device_caps & v4l2.CAP_VIDEO_CAPTURE or found.device_caps & _MEMORY_TO_MEMORY:
                return None
            return _text(found.driver), _text(found.bus_info), tuple(modes(fd))
        finally:
            os.close(fd)
    except OSError as error:
        raise explained(str(node), error) from error


def _link(root: Path, folder: str, node: Path) -> str:
    """The name in /dev/v4l/by-path or by-id that leads to the node; of two, which newer udev gives, the older."""
    links = sorted((root / "dev/v4l" / folder).glob("*"))  # "-usb-" comes before "-usbv2-"
    return next((_in(root, link) for link in links if link.resolve() == node.resolve()), "")


def _sibling_link(root: Path, entry: Path) -> str:
    """The by-path name of another node of the same port: where several are there, udev names only one of them."""
    port = (entry / "device").resolve()
    siblings = [other for other in entry.parent.glob("video*") if (other / "device").resolve() == port]
    links = (_link(root, "by-path", root / "dev" / other.name) for other in siblings)
    return next(filter(None, links), "") if (entry / "device").exists() else ""


def _id_path(by_path: str) -> str:
    """udev's ID_PATH, of which it makes the link's name (60-persistent-v4l.rules)."""
    return re.sub(r"-video-index\d+$", "", by_path.rpartition("/")[2])


def _in(root: Path, path: Path) -> str:
    return "/" + path.relative_to(root).as_posix()


def _read(path: Path) -> str:
    try:
        return path.read_text("utf-8", "replace").strip()[:200]
    except OSError:
        return ""


def _linked_name(path: Path) -> str:
    return path.resolve().name if path.exists() else ""


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", "replace")
