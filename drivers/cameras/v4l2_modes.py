"""What a capture device offers to send, and which of it is taken for a image of a size and a rate."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.errors import DriverError

# what each format is called in a Frame; the order is the order of choice: no decoding first, then fewer bytes
ENCODINGS: Final = {"GREY": "mono8", "NV12": "nv12", "YUYV": "yuyv", "UYVY": "uyvy", "MJPG": "jpeg", "JPEG": "jpeg"}
BYTES_PER_PIXEL: Final = {"GREY": 1, "NV12": 1, "YUYV": 2, "UYVY": 2}  # of a row of the first plane; else compressed
RATE_TOLERANCE: Final = 0.02  # 29.97 Hz is 30 Hz
_MAX_LISTED = 256  # of anything that a driver enumerates


@dataclass(frozen=True, slots=True)
class Sizes:
    """Widths or heights from low to high in steps, px."""

    low: int
    high: int
    step: int = 1

    def __contains__(self, size: int) -> bool:
        return self.low <= size <= self.high and (size - self.low) % max(1, self.step) == 0

    def __str__(self) -> str:
        return str(self.low) if self.low == self.high else f"{self.low}..{self.high}"


@dataclass(frozen=True, slots=True)
class Mode:
    """A format, its sizes and its rates; where the driver does not tell rates, there are none."""

    pixel_format: str  # four letters
    widths: Sizes
    heights: Sizes
    rates_hz: tuple[float, ...] = ()  # falling; a driver that takes all rates between two tells these

    def has(self, width_px: int, height_px: int) -> bool:
        """Whether the size is one of its sizes."""
        return width_px in self.widths and height_px in self.heights

    def reaches(self, rate_hz: float) -> bool:
        """Whether the rate is not above the highest, as far as is known; 0 stands for any."""
        return not self.rates_hz or rate_hz <= self.rates_hz[0] * (1 + RATE_TOLERANCE)

    def __str__(self) -> str:
        rates = ", ".join(f"{rate:.4g}" for rate in self.rates_hz)
        return f"{self.pixel_format} {self.widths}x{self.heights}" + (f" at {rates} Hz" if rates else "")


_ANY_SIZE: Final = (Sizes(1, 16384), Sizes(1, 16384))  # of a driver that tells none: what it gives is looked at


def choose(modes: Iterable[Mode], pixel_format: str, size_px: tuple[int, int], rate_hz: float) -> str:
    """The four letters of the format to ask for: the one named, or for "auto" the first of ENCODINGS that fits.

    DriverError where the device does not offer it, with what it offers.
    """
    offered = list(modes)
    wanted = tuple(ENCODINGS) if pixel_format == "auto" else (pixel_format,)
    fitting = {mode.pixel_format for mode in offered if mode.has(*size_px) and mode.reaches(rate_hz)}
    for name in wanted:
        if name in fitting:
            return name
    asked = f"{pixel_format} {size_px[0]}x{size_px[1]} at {rate_hz:g} Hz"
    known = [str(mode) for mode in offered if mode.pixel_format in ENCODINGS]
    found = "; ".join(known[:12]) + ("; ..." if len(known) > 12 else "") or "no format that is known here"
    raise DriverError(f"{asked} is not offered; choose from: {found}")


def modes(fd: int) -> list[Mode]:
    """All modes of an open device, in the driver's order."""
    return [Mode(v4l2.fourcc(code), widths, heights, tuple(_rates(fd, code, widths.low, heights.low)))
            for code in _formats(fd) for widths, heights in list(_sizes(fd, code)) or [_ANY_SIZE]]


def _formats(fd: int) -> Iterator[int]:
    def ask(index: int) -> v4l2.FormatDescription:
        entry = v4l2.FormatDescription(index=index, type=v4l2.CAPTURE)
        v4l2.call(fd, v4l2.ENUM_FMT, entry)
        return entry

    return (entry.pixelformat for entry in _each(ask))


def _sizes(fd: int, code: int) -> Iterator[tuple[Sizes, Sizes]]:
    def ask(index: int) -> v4l2.FrameSize:
        entry = v4l2.FrameSize(index=index, pixel_format=code)
        v4l2.call(fd, v4l2.ENUM_FRAMESIZES, entry)
        return entry

    for entry in _each(ask):
        low_w, high_w, step_w, low_h, high_h, step_h = entry.size
        if entry.type == v4l2.DISCRETE:
            yield Sizes(low_w, low_w), Sizes(high_w, high_w)  # two numbers: width and height
        else:
            yield Sizes(low_w, high_w, step_w), Sizes(low_h, high_h, step_h)
            return


def _rates(fd: int, code: int, width: int, height: int) -> Iterator[float]:
    def ask(index: int) -> v4l2.FrameInterval:
        entry = v4l2.FrameInterval(index=index, pixel_format=code, width=width, height=height)
        v4l2.call(fd, v4l2.ENUM_FRAMEINTERVALS, entry)
        return entry

    rates: set[float] = set()
    for entry in _each(ask):
        told = entry.interval[:1] if entry.type == v4l2.DISCRETE else entry.interval[:2]
        rates |= {interval.denominator / interval.numerator for interval in told if interval.numerator}
        if entry.type != v4l2.DISCRETE:
            break
    return iter(sorted(rates, reverse=True))


def _each(ask: Callable[[int], Any]) -> Iterator[Any]:
    """What the driver answers for index 0, 1, ... until it has no more, which it says by an error."""
    for index in range(_MAX_LISTED):
        try:
            entry = ask(index)
        except OSError:
            return
        yield entry
