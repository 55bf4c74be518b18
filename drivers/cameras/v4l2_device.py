"""Capture devices: those that are plugged in, and one opening of a device, configured, mapped and streaming."""

from __future__ import annotations

import errno
import mmap
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.v4l2_controls import ExposureControls, apply_controls, list_controls, plan_controls
from drivers.cameras.v4l2_settings import ENCODINGS, V4l2Settings
from drivers.errors import DriverError

RULES_FILE: Final = "/etc/udev/rules.d/70-omnid-cameras.rules"  # ID_PATH is set by 60-persistent-v4l.rules
_MEMORY_TO_MEMORY: Final = 0x8000 | 0x4000  # V4L2_CAP_VIDEO_M2M and V4L2_CAP_VIDEO_M2M_MPLANE: codecs
_BYTES_PER_PIXEL: Final = {"GREY": 1, "NV12": 1, "YUYV": 2, "UYVY": 2}  # of the first plane; others are compressed
_RATE_TOLERANCE: Final = 0.02  # relative; 29.97 Hz passes for 30 Hz
_MIN_BUFFERS: Final = 2  # one to fill while the other is read
_MILLIHERTZ: Final = 1000  # rates are requested as whole thousandths of 1 Hz
_ADVICE: Final = {
    errno.ENOENT: "is not there; check the cable and the name, `omnid cameras` lists the cameras",
    errno.EACCES: "may not be read by this user; add the user to group video and log in again",
    errno.EPERM: "may not be read by this service; allow char-video4linux in its DeviceAllow",
    errno.EBUSY: "is used by another program; stop it (`fuser -v` names it)",
    errno.ENODEV: "is gone; check the cable",
    errno.ENXIO: "is gone; check the cable",
    errno.ENOTTY: "is not a video device; `omnid cameras` lists those that are",
    errno.ENOSPC: "gets no bandwidth on its USB bus; choose MJPG, a smaller image, a lower rate or another port",
}


@dataclass(frozen=True, slots=True)
class StreamFormat:
    """Format, size and rate in force of the images of a stream."""

    pixel_format: str  # four letters
    width_px: int
    height_px: int
    step: int  # bytes from row to row, 0 if compressed
    rate_hz: float  # 0: unknown

    @property
    def encoding(self) -> str:
        """The name of the format in a Frame."""
        return ENCODINGS[self.pixel_format]

    @property
    def min_bytes(self) -> int:
        """Size of the smallest complete image [bytes]; of NV12, whose chroma is not needed, the luma plane."""
        return max(1, self.step * self.height_px)

    def __str__(self) -> str:
        rate = f" at {self.rate_hz:.4g} Hz" if self.rate_hz else ""
        return f"{self.pixel_format} {self.width_px}x{self.height_px}{rate}"


def device_error(device: str, error: OSError) -> DriverError:
    """Return a DriverError that explains a system error of a device and advises what to do."""
    advice = _ADVICE.get(error.errno or 0, f"failed ({error.strerror or error}); unplug it and plug it in again")
    return DriverError(f"camera {device} {advice}")


@contextmanager
def _opened(device: str | os.PathLike[str]) -> Iterator[int]:
    """Open a device without waiting for it, and close it at the end; raise OSError."""
    fd = os.open(device, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        yield fd
    finally:
        os.close(fd)


class V4l2Stream:
    """A device opened for this program alone; raises DriverError where it cannot be opened or configured."""

    def __init__(self, settings: V4l2Settings) -> None:
        self._resources = ExitStack()
        try:
            self.fd = self._resources.enter_context(_opened(settings.device))
            self.bus_info = _require_capture(self.fd)
            self.image = _set_image(self.fd, settings)
            self._maps = [self._mapped(index) for index in range(_request_buffers(self.fd, settings.buffers))]
            apply_controls(self.fd, plan_controls(settings, list_controls(self.fd)))
            self.exposure = ExposureControls(self.fd, with_gain=settings.gain < 0 and settings.auto_gain == "keep")
            self._resources.callback(_quietly, self.exposure.release)
            self._start()
        except OSError as error:
            self._resources.close()
            raise device_error(settings.device, error) from error
        except DriverError as error:
            self._resources.close()
            raise DriverError(f"camera {settings.device}: {error}") from error
        except BaseException:
            self._resources.close()
            raise

    def dequeue(self) -> tuple[v4l2.V4l2Buffer, bytes] | None:
        """Return the oldest filled buffer and a copy of its bytes, None if there is none.

        Raises OSError for a lost device.
        """
        buffer = v4l2.V4l2Buffer(type=v4l2.CAPTURE, memory=v4l2.MMAP)
        try:
            v4l2.call(self.fd, v4l2.DQBUF, buffer)
        except BlockingIOError:
            return None
        data = self._maps[buffer.index][: buffer.bytesused]
        filled = v4l2.V4l2Buffer.from_buffer_copy(buffer)  # QBUF overwrites the structure
        v4l2.call(self.fd, v4l2.QBUF, buffer)
        return filled, data

    def close(self) -> None:
        """Release the device, lost or not; may be called twice."""
        self._resources.close()

    def _mapped(self, index: int) -> mmap.mmap:
        buffer = v4l2.V4l2Buffer(index=index, type=v4l2.CAPTURE, memory=v4l2.MMAP)
        v4l2.call(self.fd, v4l2.QUERYBUF, buffer)
        mapped = mmap.mmap(self.fd, buffer.length, flags=mmap.MAP_SHARED, prot=mmap.PROT_READ, offset=buffer.m.offset)
        self._resources.callback(mapped.close)
        return mapped

    def _start(self) -> None:
        for index in range(len(self._maps)):
            v4l2.call(self.fd, v4l2.QBUF, v4l2.V4l2Buffer(index=index, type=v4l2.CAPTURE, memory=v4l2.MMAP))
        off = partial(v4l2.call, self.fd, v4l2.STREAMOFF, v4l2.Int32(v4l2.CAPTURE))
        self._resources.callback(_quietly, off)
        v4l2.call(self.fd, v4l2.STREAMON, v4l2.Int32(v4l2.CAPTURE))


def _query_capability(fd: int) -> v4l2.Capability:
    """Return the identity of the device and the capabilities of this node of it (`device_caps`)."""
    found = v4l2.Capability()
    v4l2.call(fd, v4l2.QUERYCAP, found)
    if not found.capabilities & v4l2.CAP_DEVICE_CAPS:
        found.device_caps = found.capabilities
    return found


def _require_capture(fd: int) -> str:
    """Return the bus_info of a capture device: where it is plugged in; raise DriverError for any other device."""
    found = _query_capability(fd)
    needed = v4l2.CAP_VIDEO_CAPTURE | v4l2.CAP_STREAMING
    if found.device_caps & needed != needed:
        raise DriverError(
            "is no capture device now; `omnid cameras` lists those that are (a loopback device is one "
            "only while a program writes to it)"
        )
    return str(found.bus_info.decode("utf-8", "replace"))


def _set_image(fd: int, settings: V4l2Settings) -> StreamFormat:
    """Set format, size and rate, and return them; for "auto" the first format that the device accepts with both.

    Raises DriverError, which names what the device sets instead, if it accepts none.
    """
    instead: list[StreamFormat] = []
    busy: OSError | None = None
    for name in ENCODINGS if settings.pixel_format == "auto" else (settings.pixel_format,):
        try:
            found = _image_in_force(fd, settings, name)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EBUSY):  # EBUSY: of this format only, or of all
                raise
            busy = error if error.errno == errno.EBUSY else busy
            continue
        has_size = (found.width_px, found.height_px) == (settings.width_px, settings.height_px)
        has_rate = abs(found.rate_hz - settings.rate_hz) <= _RATE_TOLERANCE * settings.rate_hz or not settings.rate_hz
        if found.pixel_format == name and has_size and has_rate:
            return found
        instead.append(found)
    if busy is not None and not instead:
        raise busy
    rate = f" at {settings.rate_hz:g} Hz" if settings.rate_hz else ""
    raise DriverError(
        f"{settings.pixel_format} {settings.width_px}x{settings.height_px}{rate} is not offered; the device sets "
        f"{', '.join(dict.fromkeys(map(str, instead))) or 'nothing'} instead: choose a mode that "
        f"`v4l2-ctl -d {settings.device} --list-formats-ext` lists"
    )


def _image_in_force(fd: int, settings: V4l2Settings, pixel_format: str) -> StreamFormat:
    """Ask for a format with the size and the rate of the settings, and return what the device sets."""
    # 1. Format and size.
    requested = v4l2.Format(type=v4l2.CAPTURE)
    requested.fmt.pix.width, requested.fmt.pix.height = settings.width_px, settings.height_px
    requested.fmt.pix.pixelformat, requested.fmt.pix.field = v4l2.fourcc_code(pixel_format), v4l2.PROGRESSIVE
    v4l2.call(fd, v4l2.S_FMT, requested)
    in_force = v4l2.Format(type=v4l2.CAPTURE)
    v4l2.call(fd, v4l2.G_FMT, in_force)
    # 2. The rate.
    if settings.rate_hz:
        rate = v4l2.StreamParameters(type=v4l2.CAPTURE)
        rate.timeperframe = v4l2.Fraction(_MILLIHERTZ, round(settings.rate_hz * _MILLIHERTZ))
        with suppress(OSError):  # the rate in force is read next
            v4l2.call(fd, v4l2.S_PARM, rate)
    # 3. What is in force.
    found, rate_hz = v4l2.StreamParameters(type=v4l2.CAPTURE), 0.0
    with suppress(OSError):  # a device need not state it
        v4l2.call(fd, v4l2.G_PARM, found)
        interval = found.timeperframe
        rate_hz = interval.denominator / interval.numerator if interval.numerator else 0.0
    pix = in_force.fmt.pix
    name = v4l2.fourcc(pix.pixelformat)
    row_bytes = _BYTES_PER_PIXEL.get(name, 0) * pix.width
    return StreamFormat(name, pix.width, pix.height, max(row_bytes, pix.bytesperline) if row_bytes else 0, rate_hz)


def _request_buffers(fd: int, count: int) -> int:
    """Allocate buffers and return their number; from now on other programs get EBUSY.

    Raises DriverError where there are fewer than 2.
    """
    request = v4l2.BufferRequest(count=count, type=v4l2.CAPTURE, memory=v4l2.MMAP)
    v4l2.call(fd, v4l2.REQBUFS, request)
    if request.count < _MIN_BUFFERS:
        raise DriverError(
            f"{count} buffers were requested, the device gave {request.count}; streaming needs {_MIN_BUFFERS}"
        )
    return int(request.count)


def _quietly(release: Callable[[], None]) -> None:
    """Release a part of a device; one that is gone has released it, and starts with its automatic modes."""
    with suppress(OSError):
        release()


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
    problem: str = ""  # reason why it could not be queried
    exposure: str = ""  # ranges of exposure time and gain as text, "" where they cannot be set


def capture_devices(root: Path = Path("/")) -> list[CaptureDevice]:
    """Return the capture devices of the system by number.

    root: replaces / by another tree with sys/class/video4linux and dev. A node that cannot be opened is listed with
    its problem; metadata nodes, outputs and codecs are left out.
    """
    nodes = sorted((root / "sys/class/video4linux").glob("video*"), key=lambda path: (len(path.name), path.name))
    found = [_device(root, path) for path in nodes if _text(path / "index") in ("0", "")]
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


def offered_image(settings: V4l2Settings) -> StreamFormat | None:
    """Return the image that a device gives with these settings; None while another program uses it.

    Raises DriverError where the device cannot be opened or offers no such image.
    """
    try:
        with _opened(settings.device) as fd:
            return _set_image(fd, settings)
    except OSError as error:
        if error.errno == errno.EBUSY:
            return None
        raise device_error(settings.device, error) from error


def _device(root: Path, entry: Path) -> CaptureDevice | None:
    """Return the device of an entry in sysfs, None if it is not a capture device."""
    node = root / "dev" / entry.name
    driver = (entry / "device/driver").resolve().name if (entry / "device/driver").exists() else ""
    bus = problem = exposure = ""
    try:
        with _opened(node) as fd:
            found = _query_capability(fd)
            if not found.device_caps & v4l2.CAP_VIDEO_CAPTURE or found.device_caps & _MEMORY_TO_MEMORY:
                return None
            driver, bus = found.driver.decode("utf-8", "replace"), found.bus_info.decode("utf-8", "replace")
            exposure = str(ExposureControls(fd))
    except OSError as error:
        problem = str(device_error(str(node), error))
    # udev's ID_PATH is a part of the link's name (60-persistent-v4l.rules), which only one node of a port has.
    port, by_path = (entry / "device").resolve(), _link(root, "by-path", node)
    siblings = [other.name for other in entry.parent.glob("video*") if (other / "device").resolve() == port]
    links = (by_path, *(_link(root, "by-path", root / "dev" / name) for name in siblings if port.exists()))
    id_path = re.sub(r"-video-index\d+$", "", next(filter(None, links), "").rpartition("/")[2])
    names = _path_in(root, node), _text(entry / "name"), driver, bus, by_path, _link(root, "by-id", node)
    return CaptureDevice(*names, id_path, problem, exposure)


def _link(root: Path, folder: str, node: Path) -> str:
    """Return the link in /dev/v4l/by-path or by-id to the node, "" without one.

    Newer versions of udev make two links for a port; the one with the older name is returned.
    """
    links = sorted((root / "dev/v4l" / folder).glob("*"))  # "-usb-" sorts before "-usbv2-"
    return next((_path_in(root, link) for link in links if link.resolve() == node.resolve()), "")


def _path_in(root: Path, path: Path) -> str:
    return "/" + path.relative_to(root).as_posix()


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8", "replace").strip()
    except OSError:
        return ""
