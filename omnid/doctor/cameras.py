"""Checks of the cameras: presence, modes, and the bandwidth of USB.

A high-speed USB 2 bus carries 480 Mbit/s, of which all streams together get 80 %, and one stream 3 packets of 1024
bytes per microframe of 125 us (USB 2.0, 5.6.3 and 5.6.4).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.cameras.v4l2_devices import CaptureDevice
from drivers.cameras.v4l2_modes import choose_format
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError
from omnid.doctor.devices import access, holders
from omnid.doctor.finding import Finding

HIGH_SPEED_MBPS: Final = 480.0
BUS_MBPS: Final = 0.8 * HIGH_SPEED_MBPS
STREAM_MBPS: Final = 3 * 1024 * 8 * 8000 * 1e-6
BYTES_PER_PIXEL: Final = {"GREY": 1.0, "NV12": 1.5, "YUYV": 2.0, "UYVY": 2.0}  # all planes; others are compressed
_USUAL_RATE_HZ: Final = 30.0
_OTHER_PORT = "plug one into a port of another USB controller, see `lsusb -t`"


@dataclass(frozen=True, slots=True)
class CameraStream:
    """Data rate of a camera and its USB bus."""

    name: str
    pixel_format: str
    rate_mbps: float  # 0: unknown, since compressed
    bus: str  # number of the USB bus, "" without one
    bus_mbps: float  # speed of the camera on it


def cameras(wanted: Mapping[str, V4l2Settings], known: list[CaptureDevice], root: Path) -> Iterator[Finding]:
    """Yield findings for each configured camera and each USB bus; known: the cameras that are connected.

    root: folder of sys, dev and proc.
    """
    streams: list[CameraStream] = []
    for name, settings in wanted.items():
        device = _found(settings, known, root)
        yield from _camera(name, settings, device, root)
        if device is not None and (stream := _stream(name, settings, device, root)):
            streams.append(stream)
    nodes = {_resolved(settings.device, root) for settings in wanted.values()}
    if len(nodes) < len(wanted):
        yield Finding(
            "error", "cameras", "both names lead to one device", "configure one device for each, see `omnid cameras`"
        )
    yield from buses(streams)


def buses(streams: list[CameraStream]) -> Iterator[Finding]:
    """Yield a finding per USB bus: its bandwidth against the data rate of its cameras."""
    by_bus: defaultdict[str, list[CameraStream]] = defaultdict(list)
    for stream in streams:
        by_bus[stream.bus].append(stream)
    for bus, sharing in sorted(by_bus.items()):
        yield _bus(f"usb bus {bus}", sharing) if bus else Finding("ok", "usb", f"{_names(sharing)}: not on USB")


def _bus(subject: str, sharing: list[CameraStream]) -> Finding:
    slow = [stream for stream in sharing if stream.bus_mbps <= HIGH_SPEED_MBPS]
    needed_mbps = sum(stream.rate_mbps for stream in slow)
    for stream in slow:
        if stream.rate_mbps > STREAM_MBPS:
            return Finding(
                "error",
                subject,
                f"{stream.name} would send {stream.rate_mbps:.0f} Mbit/s, one camera can "
                f"send {STREAM_MBPS:.0f} over USB 2",
                "lower cameras.rate_hz or the size, or use MJPG",
            )
    if needed_mbps > BUS_MBPS:
        return Finding(
            "error",
            subject,
            f"{_names(slow)} would send {needed_mbps:.0f} Mbit/s over one USB 2 bus, which carries {BUS_MBPS:.0f}",
            f"{_OTHER_PORT}, or lower cameras.rate_hz",
        )
    if len(slow) > 1 and not all(stream.rate_mbps for stream in slow):
        return Finding(
            "warning",
            subject,
            f"{_names(slow)} share a USB 2 bus, on which many cameras reserve more than their compressed images need",
            f"if one does not start (no space left): {_OTHER_PORT}",
        )
    sent = f"{needed_mbps:.0f} of {BUS_MBPS:.0f} Mbit/s" if needed_mbps else f"{sharing[0].bus_mbps:.0f} Mbit/s"
    return Finding("ok", subject, f"{_names(sharing)}: {sent}")


def _camera(name: str, settings: V4l2Settings, device: CaptureDevice | None, root: Path) -> Iterator[Finding]:
    """Yield ok if a camera can be used as configured, else all reasons against it."""
    subject, path = f"camera {name}", root / settings.device.lstrip("/")
    if not path.exists():
        yield Finding(
            "error",
            subject,
            f"{settings.device} does not exist",
            "connect the camera; `omnid cameras` lists the cameras and the udev rule for this name",
        )
    elif device is None:
        yield Finding("error", subject, f"{settings.device} is no camera", "choose a device that `omnid cameras` lists")
    else:
        problems = [*access(subject, path), *_problems(subject, settings, device)]
        others = holders(path, root)
        if others:
            problems.append(
                Finding("warning", subject, f"{settings.device} is open in {', '.join(others)}", "end that program")
            )
        yield from problems or [
            Finding(
                "ok",
                subject,
                f"{device.name} at {device.node}, {_image(settings, device)}{_exposure(settings, device)}",
            )
        ]


def _problems(subject: str, settings: V4l2Settings, device: CaptureDevice) -> Iterator[Finding]:
    if device.problem:
        yield Finding("error", subject, device.problem)
        return
    try:
        _format(settings, device)
    except DriverError as error:
        yield Finding("error", subject, str(error), "change section [cameras] of the configuration")


def _format(settings: V4l2Settings, device: CaptureDevice) -> str:
    size = settings.width_px, settings.height_px
    return choose_format(device.modes, settings.pixel_format, size, settings.rate_hz)


def _image(settings: V4l2Settings, device: CaptureDevice) -> str:
    rate = f" at {settings.rate_hz:g} Hz" if settings.rate_hz else ""
    return f"{_format(settings, device)} {settings.width_px}x{settings.height_px}{rate}"


def _exposure(settings: V4l2Settings, device: CaptureDevice) -> str:
    """Return how the exposure is set, for the end of a line; "" where the camera's own is wanted."""
    if not settings.is_regulated:
        return ""
    return f", {device.exposure} set by omnid run" if device.exposure else ", exposure left to it: it cannot be set"


def _stream(name: str, settings: V4l2Settings, device: CaptureDevice, root: Path) -> CameraStream | None:
    """Return the stream of a camera; None if the configured mode is not offered."""
    try:
        pixel_format = _format(settings, device)
    except DriverError:
        return None
    bits = settings.width_px * settings.height_px * BYTES_PER_PIXEL.get(pixel_format, 0.0) * 8
    return CameraStream(name, pixel_format, bits * (settings.rate_hz or _USUAL_RATE_HZ) * 1e-6, *_usb(device, root))


def _usb(device: CaptureDevice, root: Path) -> tuple[str, float]:
    """Return number of the USB bus and speed of the camera on it, Mbit/s; ("", 0) without USB."""
    port = (root / "sys/class/video4linux" / Path(device.node).name / "device").resolve()
    with suppress(OSError, ValueError):  # being unplugged, or of unknown speed
        for folder in (port, *port.parents):
            if (folder / "busnum").is_file():
                return (folder / "busnum").read_text().strip(), float((folder / "speed").read_text())
    return "", 0.0


def _found(settings: V4l2Settings, known: list[CaptureDevice], root: Path) -> CaptureDevice | None:
    asked = _resolved(settings.device, root)
    return next((device for device in known if _resolved(device.node, root) == asked), None)


def _resolved(device: str, root: Path) -> Path:
    return (root / device.lstrip("/")).resolve()


def _names(streams: list[CameraStream]) -> str:
    return " and ".join(f"{stream.name} ({stream.pixel_format})" for stream in streams)
