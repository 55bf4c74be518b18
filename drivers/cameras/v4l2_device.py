"""V4L2 devices: those that are plugged in; settings; one opening, configured, mapped and streaming, and its controls.

A run may regulate the exposure (`follow_request`).
"""

from __future__ import annotations

import errno
import mmap
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final, NamedTuple

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.camera_state import CameraExposure, ExposureRanges, ExposureSetting, ValueRange
from drivers.cameras.v4l2_ioctl import ControlId, ExposureMode
from drivers.errors import DriverError

EXPOSURE_UNIT_US: Final = 100  # unit of V4L2_CID_EXPOSURE_ABSOLUTE
_POWER_LINE: Final = ("off", "50", "60", "auto")  # enum v4l2_power_line_frequency
_LOST: Final = (errno.ENODEV, errno.EBUSY)  # the camera is opened again, with its settings and its request


@dataclass(frozen=True, slots=True)
class V4l2Settings:
    """Device, image and controls. "keep" leaves a control as the camera has it."""

    device: str  # a path that persists when the camera is plugged in again: /dev/omnid/lower, /dev/v4l/by-path/...
    width_px: int = 1280
    height_px: int = 960
    rate_hz: float = 30.0  # 0: the device's own
    pixel_format: str = "auto"  # or a key of ENCODINGS
    auto_exposure: str = "keep"  # keep, on, off or rig: set by a run, by the requests of CameraExposure, else as "on"
    exposure_us: int = 0  # above 0: fixed, automatic exposure off; in steps of 100
    gain: int = -1  # 0 and above: fixed, in the device's own units, automatic gain off
    power_line: str = "keep"  # keep, off, 50, 60 (Hz) or auto: suppresses the flicker of lamps
    controls: tuple[str, ...] = ()  # any others, as `v4l2-ctl --list-ctrls` names them: "focus_absolute=2"
    timeout_s: float = 2.0  # the device is opened again after this time without an image

    @property
    def is_regulated(self) -> bool:
        """True if a run sets the exposure by requests."""
        return self.auto_exposure == "rig" and not self.exposure_us


class CameraControl(NamedTuple):
    """One control of a device."""

    id: int
    name: str  # the driver's, as `v4l2-ctl --list-ctrls` writes it: gain, exposure_time_absolute
    range: ValueRange


def list_controls(fd: int) -> dict[int, CameraControl]:
    """Return the writable controls of an open device by id."""
    found, last = dict[int, CameraControl](), 0
    while True:
        # The driver returns the control after `last`, and an error after the last one; a faulty one may go in circles.
        entry = v4l2.QueryControl(id=last | v4l2.ControlFlag.NEXT_CTRL)
        try:
            v4l2.call(fd, "QUERYCTRL", entry)
        except OSError:
            return found
        if entry.id <= last:
            return found
        last = entry.id
        if not entry.flags & (v4l2.ControlFlag.DISABLED | v4l2.ControlFlag.READ_ONLY):
            # As v4l2-ctl writes it: exposure_time_absolute for 'Exposure Time, Absolute'.
            name = re.sub(r"[^a-z0-9]+", "_", entry.name.decode("utf-8", "replace").lower()).strip("_")
            found[last] = CameraControl(last, name, ValueRange(entry.minimum, entry.maximum, max(1, entry.step)))


def set_controls(fd: int, settings: V4l2Settings) -> None:
    """Set the controls of the settings, automatic modes before the values that they govern, and read each back.

    A fixed value switches its automatic mode off. Raises DriverError for a control that the device does not offer, and
    for a value that it does not take; OSError for a lost device.
    """
    offered = list_controls(fd)
    # 1. The wanted values: the setting, the control, the value and what may stand for it.
    wanted: list[tuple[str, int, tuple[int, ...]]] = []
    is_manual = settings.exposure_us > 0 or settings.auto_exposure == "off"
    if is_manual or settings.auto_exposure == "on" or (settings.is_regulated and ControlId.AUTO_EXPOSURE in offered):
        # An exposure that a run regulates is automatic until the run sends its first value.
        modes = (ExposureMode.MANUAL,) if is_manual else (ExposureMode.AUTO, ExposureMode.APERTURE_PRIORITY)
        wanted.append(("auto_exposure", ControlId.AUTO_EXPOSURE, modes))
    if settings.auto_exposure != "keep" or is_manual:
        wanted += [("", ControlId.EXPOSURE_AUTO_PRIORITY, (0,))] if ControlId.EXPOSURE_AUTO_PRIORITY in offered else []
    if is_manual and settings.exposure_us:
        wanted.append(("exposure_us", ControlId.EXPOSURE, (round(settings.exposure_us / EXPOSURE_UNIT_US),)))
    if (settings.gain >= 0 or settings.is_regulated) and ControlId.AUTO_GAIN in offered:
        wanted.append(("", ControlId.AUTO_GAIN, (int(settings.gain < 0),)))
    if settings.gain >= 0:
        wanted.append(("gain", ControlId.GAIN, (settings.gain,)))
    if settings.power_line != "keep":
        wanted.append(("power_line", ControlId.POWER_LINE_FREQUENCY, (_POWER_LINE.index(settings.power_line),)))
    # 2. Others by their names.
    ids = {control.name: control.id for control in offered.values()}
    for text in settings.controls:
        entry = re.fullmatch(r"(\w+) *= *(-?\d{1,10})", text)
        if entry is None:
            raise DriverError(f"controls has {text!r}; give entries such as 'gain=3'")
        wanted.append((f"controls: {entry[1]}", ids.get(entry[1], 0), (int(entry[2]),)))
    # 3. Set one after the other.
    for setting, control_id, values in wanted:
        if control_id not in offered:
            raise DriverError(f"the device has no control for cameras.{setting}. It has: {', '.join(ids) or 'none'}")
        refusal = _refusal(fd, offered[control_id], values[0])
        if refusal and values[1:]:
            refusal = _refusal(fd, offered[control_id], values[1])
        if refusal:
            raise DriverError(refusal)


def _refusal(fd: int, control: CameraControl, value: int) -> str:
    """Set a control and read it back; return why the device did not take the value, empty where it did."""
    try:
        _write(fd, control.id, value)
        found = _read(fd, control.id)
    except OSError as error:
        if error.errno in _LOST:
            raise
        return (
            f"control {control.name}: the device refused {value} ({error.strerror}); it accepts {control.range.low} to "
            f"{control.range.high}, and some only while their automatic mode is off"
        )
    return "" if found == value else f"control {control.name}: {value} was set, the device stays at {found}"


def _read(fd: int, control_id: int) -> int:
    control = v4l2.V4l2Control(control_id)
    v4l2.call(fd, "G_CTRL", control)
    return int(control.value)


def _write(fd: int, control_id: int, value: int) -> None:
    v4l2.call(fd, "S_CTRL", v4l2.V4l2Control(control_id, value))


def exposure_ranges(fd: int, settings: V4l2Settings) -> ExposureRanges | None:
    """Return the ranges of exposure time and gain that a run may set; None where the device has no exposure time.

    A gain that the settings fix is not set.
    """
    offered = list_controls(fd)
    if ControlId.EXPOSURE not in offered:
        return None
    times = offered[ControlId.EXPOSURE].range
    low, high, step = (value * EXPOSURE_UNIT_US for value in (times.low, times.high, times.step))
    gain = offered[ControlId.GAIN].range if ControlId.GAIN in offered and settings.gain < 0 else None
    return ExposureRanges(ValueRange(low, high, step), gain)


def exposure_in_force(fd: int, ranges: ExposureRanges) -> ExposureSetting | None:
    """Return exposure time and gain as the device reports them; None where it does not."""
    with suppress(OSError):
        gain = None if ranges.gain is None else _read(fd, ControlId.GAIN)
        return ExposureSetting(_read(fd, ControlId.EXPOSURE) * EXPOSURE_UNIT_US, gain)
    return None


def follow_request(fd: int, settings: V4l2Settings, exposure: CameraExposure, stamp_ns: int) -> None:
    """Carry out the newest request, if it is new and due after an image with that stamp.

    A value that the device refuses is kept as `exposure.problem`, and the camera's own exposure is in force again.
    Raises OSError for a lost device.
    """
    request = exposure.request
    if request is None or request is exposure.done or stamp_ns < request.after_ns or exposure.problem:
        return
    exposure.done = request
    try:
        if request.setting is None:
            set_controls(fd, settings)
        else:
            _set_exposure(fd, request.setting)
    except (OSError, DriverError) as error:
        if isinstance(error, OSError) and error.errno in _LOST:
            raise
        exposure.problem = f"it refused an exposure ({error})"
        with suppress(OSError, DriverError):
            set_controls(fd, settings)
    exposure.in_force = exposure_in_force(fd, exposure.ranges)


def _set_exposure(fd: int, setting: ExposureSetting) -> None:
    """Switch the automatic modes off, where the device has them, and set the values."""
    offered = list_controls(fd)
    values: list[tuple[int, int]] = (
        [(ControlId.AUTO_EXPOSURE, ExposureMode.MANUAL)] if ControlId.AUTO_EXPOSURE in offered else []
    )
    values += [(ControlId.AUTO_GAIN, 0)] if ControlId.AUTO_GAIN in offered and setting.gain is not None else []
    values.append((ControlId.EXPOSURE, round(setting.exposure_us / EXPOSURE_UNIT_US)))
    values += [(ControlId.GAIN, setting.gain)] if setting.gain is not None else []
    for control_id, value in values:
        _write(fd, control_id, value)


# V4L2's fourcc -> the name in a Frame, in the order of preference: no decoding first, then fewer bytes
ENCODINGS: Final = {"GREY": "mono8", "NV12": "nv12", "YUYV": "yuyv", "UYVY": "uyvy", "MJPG": "jpeg", "JPEG": "jpeg"}
_BUFFERS: Final = 4  # v4l2loopback needs exactly this number
_ADVICE: Final = {
    errno.ENOENT: "is not there; check the cable and the name, `omnid cameras` lists the cameras",
    errno.EACCES: "may not be read by this user; add the user to group video and log in again",
    errno.EBUSY: "is used by another program; stop it (`fuser -v` names it)",
    errno.ENODEV: "is gone; check the cable",
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
            needed = v4l2.Capability.VIDEO_CAPTURE | v4l2.Capability.STREAMING
            if _capabilities(self.fd) & needed != needed:  # a loopback device captures while a program writes to it
                raise DriverError("is no capture device now; `omnid cameras` lists those that are")
            self.image = _set_image(self.fd, settings)
            self._maps = self._mapped_buffers()
            set_controls(self.fd, settings)
            for index in range(len(self._maps)):
                v4l2.call(self.fd, "QBUF", v4l2.V4l2Buffer(index=index, type=v4l2.CAPTURE, memory=v4l2.MMAP))
            v4l2.call(self.fd, "STREAMON", v4l2.Int32(v4l2.CAPTURE))  # closing the device ends the stream
        except BaseException as error:
            self._resources.close()
            if isinstance(error, OSError):
                raise device_error(settings.device, error) from error
            if isinstance(error, DriverError):
                raise DriverError(f"camera {settings.device}: {error}") from error
            raise

    def dequeue(self) -> tuple[v4l2.V4l2Buffer, bytes] | None:
        """Return the oldest filled buffer and a copy of its bytes, None if there is none.

        Raises OSError for a lost device.
        """
        buffer = v4l2.V4l2Buffer(type=v4l2.CAPTURE, memory=v4l2.MMAP)
        try:
            v4l2.call(self.fd, "DQBUF", buffer)
        except BlockingIOError:
            return None
        data = self._maps[buffer.index][: buffer.bytesused]
        filled = v4l2.V4l2Buffer.from_buffer_copy(buffer)  # QBUF overwrites the structure
        v4l2.call(self.fd, "QBUF", buffer)
        return filled, data

    def close(self) -> None:
        """Release the device, lost or not; may be called twice."""
        self._resources.close()

    def _mapped_buffers(self) -> list[mmap.mmap]:
        """Allocate buffers; from now on other programs get EBUSY. DriverError where there are fewer than 2."""
        request = v4l2.BufferRequest(count=_BUFFERS, type=v4l2.CAPTURE, memory=v4l2.MMAP)
        v4l2.call(self.fd, "REQBUFS", request)
        if request.count < 2:  # one to fill while the other is read
            raise DriverError(f"the device gave {request.count} buffers; streaming needs 2")
        maps = list[mmap.mmap]()
        for index in range(request.count):
            buffer = v4l2.V4l2Buffer(index=index, type=v4l2.CAPTURE, memory=v4l2.MMAP)
            v4l2.call(self.fd, "QUERYBUF", buffer)
            offset = buffer.m.offset
            maps.append(mmap.mmap(self.fd, buffer.length, mmap.MAP_SHARED, mmap.PROT_READ, offset=offset))
            self._resources.callback(maps[-1].close)
        return maps


def _capabilities(fd: int) -> int:
    """Return the capabilities of this node of the device (`device_caps`)."""
    found = v4l2.DeviceCapability()
    v4l2.call(fd, "QUERYCAP", found)
    return int(found.device_caps)


def _set_image(fd: int, settings: V4l2Settings) -> StreamFormat:
    """Set format, size and rate, and return them; for "auto" the first format that the device accepts with both.

    Raises DriverError, which names what the device sets instead, if it accepts none.
    """
    refused: OSError | None = None
    instead: list[str] = []
    for name in ENCODINGS if settings.pixel_format == "auto" else (settings.pixel_format,):
        try:
            found = _image_in_force(fd, settings, name)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EBUSY):  # EBUSY: of this format only, or of all
                raise
            refused = error
            continue
        has_size = (found.width_px, found.height_px) == (settings.width_px, settings.height_px)
        has_rate = abs(found.rate_hz - settings.rate_hz) < 0.5 or not settings.rate_hz  # 29.97 Hz passes for 30 Hz
        if found.pixel_format == name and has_size and has_rate:
            return found
        instead.append(str(found))
    if not instead and refused is not None and refused.errno == errno.EBUSY:
        raise refused
    raise DriverError(
        f"{settings.pixel_format} {settings.width_px}x{settings.height_px} at {settings.rate_hz:g} Hz is not offered; "
        f"the device sets {', '.join(dict.fromkeys(instead)) or 'nothing'} instead: choose a mode that "
        f"`v4l2-ctl -d {settings.device} --list-formats-ext` lists"
    )


def _image_in_force(fd: int, settings: V4l2Settings, pixel_format: str) -> StreamFormat:
    """Ask for a format with the size and the rate of the settings, and return what the device sets."""
    # 1. Format and size.
    image = v4l2.Format(type=v4l2.CAPTURE)
    pix = image.fmt.pix
    pix.width, pix.height = settings.width_px, settings.height_px
    pix.pixelformat, pix.field = v4l2.fourcc_code(pixel_format), v4l2.PROGRESSIVE
    v4l2.call(fd, "S_FMT", image)
    # 2. The rate.
    if settings.rate_hz:
        rate = v4l2.StreamParameters(type=v4l2.CAPTURE)
        wanted = Fraction(settings.rate_hz).limit_denominator(1000)
        rate.timeperframe = v4l2.Fraction(wanted.denominator, wanted.numerator)
        with suppress(OSError):  # the rate in force is read next
            v4l2.call(fd, "S_PARM", rate)
    # 3. What is in force.
    found, rate_hz = v4l2.StreamParameters(type=v4l2.CAPTURE), 0.0
    with suppress(OSError):  # a device need not state it
        v4l2.call(fd, "G_PARM", found)
        interval = found.timeperframe
        rate_hz = interval.denominator / interval.numerator if interval.numerator else 0.0
    name = v4l2.fourcc(pix.pixelformat)
    step = 0 if ENCODINGS.get(name) == "jpeg" else pix.bytesperline
    return StreamFormat(name, pix.width, pix.height, step, rate_hz)


@dataclass(frozen=True, slots=True)
class CaptureDevice:
    """One camera, as far as it could be queried."""

    node: str  # /dev/video0; may change when the camera is plugged in again
    name: str  # given to the node by the driver, often the product's
    by_path: str  # persistent name of the port, "" if udev gave none
    problem: str = ""  # reason why it could not be queried


def capture_devices(root: Path = Path("/")) -> list[CaptureDevice]:
    """Return the capture devices of the system by number.

    root: replaces / by another tree with sys/class/video4linux and dev. A node that cannot be opened is listed with
    its problem; metadata nodes, outputs and codecs are left out.
    """
    nodes = sorted((root / "sys/class/video4linux").glob("video*"), key=lambda path: (len(path.name), path.name))
    found = [_device(root, path) for path in nodes if (path / "index").read_text("utf-8").strip() == "0"]
    return [device for device in found if device is not None]


def _device(root: Path, entry: Path) -> CaptureDevice | None:
    """Return the device of an entry in sysfs, None if it is not a capture device."""
    node, problem = root / "dev" / entry.name, ""
    try:
        with _opened(node) as fd:
            if not _capabilities(fd) & v4l2.Capability.VIDEO_CAPTURE:
                return None
    except OSError as error:
        problem = str(device_error(str(node), error))
    name = (entry / "name").read_text("utf-8", "replace").strip()
    # Newer versions of udev make two links for a port; "-usb-" sorts before "-usbv2-".
    links = sorted((root / "dev/v4l/by-path").glob("*"))
    by_path = next((f"/dev/v4l/by-path/{link.name}" for link in links if link.resolve() == node.resolve()), "")
    return CaptureDevice(f"/dev/{node.name}", name, by_path, problem)
