"""The modes of a capture device (format, size, rate) and the choice of a format."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.errors import DriverError

# V4L2's fourcc -> the name in a Frame, in the order of preference: no decoding first, then fewer bytes
ENCODINGS: Final = {"GREY": "mono8", "NV12": "nv12", "YUYV": "yuyv", "UYVY": "uyvy", "MJPG": "jpeg", "JPEG": "jpeg"}
BYTES_PER_PIXEL: Final = {"GREY": 1, "NV12": 1, "YUYV": 2, "UYVY": 2}  # of the first plane; others are compressed
RATE_TOLERANCE: Final = 0.02  # relative; 29.97 Hz passes for 30 Hz
MAX_SIZE_PX: Final = 16384
_MAX_ENUMERATED: Final = 256  # bounds every enumeration of a faulty driver
_MAX_SHOWN: Final = 12  # modes in an error message


@dataclass(frozen=True, slots=True)
class SizeRange:
    """Widths or heights from low to high in steps [px]."""

    low: int
    high: int
    step: int = 1

    def __contains__(self, size: int) -> bool:
        return self.low <= size <= self.high and (size - self.low) % max(1, self.step) == 0

    def __str__(self) -> str:
        return str(self.low) if self.low == self.high else f"{self.low}..{self.high}"


@dataclass(frozen=True, slots=True)
class Mode:
    """A format with its sizes and rates."""

    pixel_format: str  # four letters
    widths: SizeRange
    heights: SizeRange
    rates_hz: tuple[float, ...] = ()  # descending; the limits where the rate is continuous; empty if unknown

    def has_size(self, width_px: int, height_px: int) -> bool:
        """True if the size is offered."""
        return width_px in self.widths and height_px in self.heights

    def has_rate(self, rate_hz: float) -> bool:
        """True if the rate is not above the highest one, or if the rates are unknown; 0 stands for any rate."""
        return not self.rates_hz or rate_hz <= self.rates_hz[0] * (1 + RATE_TOLERANCE)

    def __str__(self) -> str:
        rates = ", ".join(f"{rate:.4g}" for rate in self.rates_hz)
        return f"{self.pixel_format} {self.widths}x{self.heights}" + (f" at {rates} Hz" if rates else "")


_ANY_SIZE: Final = (SizeRange(1, MAX_SIZE_PX), SizeRange(1, MAX_SIZE_PX))  # where the driver enumerates no sizes


def choose_format(modes: Iterable[Mode], pixel_format: str, size_px: tuple[int, int], rate_hz: float) -> str:
    """Return the four letters of the format to request: the one named, or for "auto" the first match in ENCODINGS.

    Raises DriverError, which lists what the device offers, where it has no such mode.
    """
    offered = list(modes)
    wanted = tuple(ENCODINGS) if pixel_format == "auto" else (pixel_format,)
    matching = {mode.pixel_format for mode in offered if mode.has_size(*size_px) and mode.has_rate(rate_hz)}
    for name in wanted:
        if name in matching:
            return name
    requested = f"{pixel_format} {size_px[0]}x{size_px[1]} at {rate_hz:g} Hz"
    known = [str(mode) for mode in offered if mode.pixel_format in ENCODINGS]
    found = "; ".join(known[:_MAX_SHOWN]) + ("; ..." if len(known) > _MAX_SHOWN else "") or "no supported format"
    raise DriverError(f"{requested} is not offered; choose from: {found}")


def list_modes(fd: int) -> list[Mode]:
    """Return all modes of an open device in the driver's order."""
    return [
        Mode(v4l2.fourcc(code), widths, heights, tuple(_rates(fd, code, widths.low, heights.low)))
        for code in _formats(fd)
        for widths, heights in list(_sizes(fd, code)) or [_ANY_SIZE]
    ]


def _formats(fd: int) -> Iterator[int]:
    def query(index: int) -> v4l2.FormatDescription:
        entry = v4l2.FormatDescription(index=index, type=v4l2.CAPTURE)
        v4l2.call(fd, v4l2.ENUM_FMT, entry)
        return entry

    return (entry.pixelformat for entry in _enumerate(query))


def _sizes(fd: int, code: int) -> Iterator[tuple[SizeRange, SizeRange]]:
    def query(index: int) -> v4l2.FrameSize:
        entry = v4l2.FrameSize(index=index, pixel_format=code)
        v4l2.call(fd, v4l2.ENUM_FRAMESIZES, entry)
        return entry

    for entry in _enumerate(query):
        if entry.type == v4l2.DISCRETE:
            width, height = entry.size[:2]
            yield SizeRange(width, width), SizeRange(height, height)
        else:
            min_width, max_width, width_step, min_height, max_height, height_step = entry.size
            yield SizeRange(min_width, max_width, width_step), SizeRange(min_height, max_height, height_step)
            return


def _rates(fd: int, code: int, width: int, height: int) -> Iterator[float]:
    def query(index: int) -> v4l2.FrameInterval:
        entry = v4l2.FrameInterval(index=index, pixel_format=code, width=width, height=height)
        v4l2.call(fd, v4l2.ENUM_FRAMEINTERVALS, entry)
        return entry

    rates: set[float] = set()
    for entry in _enumerate(query):
        intervals = entry.interval[:1] if entry.type == v4l2.DISCRETE else entry.interval[:2]
        rates |= {interval.denominator / interval.numerator for interval in intervals if interval.numerator}
        if entry.type != v4l2.DISCRETE:
            break
    return iter(sorted(rates, reverse=True))


def _enumerate(query: Callable[[int], Any]) -> Iterator[Any]:
    """Yield the driver's entries for index 0, 1, ... up to its first error, which marks the end (EINVAL)."""
    for index in range(_MAX_ENUMERATED):
        try:
            entry = query(index)
        except OSError:
            return
        yield entry
