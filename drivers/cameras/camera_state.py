"""State and counters of a camera, and its exposure where a program sets it: ranges, wish and values in force."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class ValueRange:
    """Range of a control in its own units."""

    low: int
    high: int
    step: int = 1

    def nearest(self, value: float) -> int:
        """Return the nearest value that the control accepts."""
        steps = round((min(max(value, self.low), self.high) - self.low) / max(1, self.step))
        return min(self.low + steps * max(1, self.step), self.high)

    def common(self, other: ValueRange) -> ValueRange:
        """Return the range of values that both controls accept, for controls of one model of camera."""
        return ValueRange(max(self.low, other.low), min(self.high, other.high), max(self.step, other.step))


@dataclass(frozen=True, slots=True)
class ExposureRanges:
    """Ranges of the exposure time and of the gain."""

    exposure_us: ValueRange
    gain: ValueRange | None = None  # in the camera's own units; None: not to be set


@dataclass(frozen=True, slots=True)
class ExposureSetting:
    """Exposure time and gain."""

    exposure_us: int
    gain: int | None = None  # None: as it is


@dataclass(frozen=True, slots=True)
class ExposureRequest:
    """A setting that the camera shall have from the first image with a stamp after after_ns on."""

    setting: ExposureSetting | None  # None: the camera's own automatic exposure again
    after_ns: int


@dataclass(slots=True)
class CameraExposure:
    """The exposure of a camera that offers to set it.

    One thread writes `request`; the capturing thread carries it out and writes the rest. Any thread may read a field.
    """

    ranges: ExposureRanges
    request: ExposureRequest | None = None  # the newest; None: none yet
    done: ExposureRequest | None = None  # the newest that was carried out
    in_force: ExposureSetting | None = None  # None: unknown
    problem: str = ""  # reason for which the device refused a request; no more are carried out until it is opened again


@dataclass(slots=True)
class CameraState:
    """Status and counters; only the capturing thread writes them, any thread may read one field at a time."""

    status: Literal["opened", "streaming", "lost", "closed"] = "opened"
    mode: str = ""  # present mode, such as "GREY 640x480 at 30 Hz"
    problem: str = ""  # reason for the status "lost"
    frames: int = 0  # images that were delivered
    drops: int = 0  # gaps in the driver's sequence numbers: captured by the camera, never received
    errors: int = 0  # buffers that the driver flagged as broken, or that are too short
    restamped: int = 0  # invalid stamps, replaced by the time of arrival
    restarts: int = 0  # restarts of the driver's sequence numbers within a stream
    losses: int = 0  # transitions to the status "lost"
    reopens: int = 0
    exposure: CameraExposure | None = None  # None: the camera offers no exposure time to set
