"""Stamps of the images of a log: all by their headers, or all by the times of logging where the headers are faulty.

A camera driver stamps the header when the image is taken; the recorder logs the message when it arrives. The header is
the better one, unless it is not set, does not advance, runs back, or counts by another clock than that of the other
camera. A recorder may log images late and out of order: such an image fills a hole between others. Where a clock was
set back, images lie beside or between others instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError
from drivers.frame import CAMERAS, Camera

Times: TypeAlias = NDArray[np.int64]  # (N,) [ns]
TimeSource: TypeAlias = Literal["auto", "header", "log"]

_SHORTEST_STEP_NS: Final = 1_000_000  # No camera takes 1,000 images a second, as stamps that hardly advance say.
STEP_NS: Final = 500_000_000  # Delays between header and logging vary by less, unless a clock is set.
_FASTEST: Final = 3.0  # Clocks and images run at rates that differ by less than this factor.
_FEW: Final = 0.1  # Up to this share of headers may be unset or repeat the one before.
_PAUSE: Final = 8  # periods; boards are photographed in no rhythm
_MANY: Final = 0.25  # Fewer images than this share are logged late.


class LoggedImages(NamedTuple):
    """The N images of a camera in the order of the file."""

    header_ns: Times  # stamps of the headers, 0 where unset
    log_ns: Times


class ImageStamps(NamedTuple):
    """The stamps of the images of both cameras, and what is wrong with their headers."""

    stamps_ns: Mapping[Camera, Times]
    by_header: bool
    delay_ns: int  # usual stamp of the lower camera minus the time of logging
    by_log: int  # images that have the time of logging instead of the header's
    warnings: list[str]

    def sample_ns(self, header_ns: Times, log_ns: Times) -> Times:
        """Return the stamps (N,) of samples of wheels or IMU by the clock of the images."""
        return np.where(self.by_header & (header_ns > 0), header_ns, log_ns + self.delay_ns)


def image_stamps(images: Mapping[Camera, LoggedImages], source: TimeSource = "auto") -> ImageStamps:
    """Return the stamps of the images of both cameras.

    Raise DriverError, by "auto", where neither headers nor times of logging can be those of a camera.
    """
    # 1. What is wrong with the times of logging, and with the headers.
    log_fault = next(filter(None, (_fault(of_camera.log_ns) for of_camera in images.values())), "")
    fault, is_auto, apart_ns = "", source == "auto", 0
    if not log_fault and all(map(_is_live, images.values())):
        apart_ns = abs(_delay_ns(images["lower"]) - _delay_ns(images["upper"]))
    if is_auto:
        fault = next(filter(None, (_header_fault(images[camera], is_logged=not log_fault) for camera in CAMERAS)), "")
        if apart_ns > STEP_NS and not fault:
            fault = f"are {apart_ns * 1e-9:.3f} s apart between the cameras"
        if fault and log_fault:
            raise DriverError(
                f"the stamps of its images' headers {fault}, and the times of logging {log_fault}: expected one that "
                'runs on; cut the log there, or choose: log.time = "header" or "log"'
            )
    # 2. The stamps. A header that is not set is replaced by the time of logging and the usual delay.
    by_header = source == "header" or (is_auto and not fault)
    delay_ns = _delay_ns(images["lower"]) if by_header and not log_fault else 0
    stamps_ns, unset = dict[Camera, Times](), 0
    for camera, (header_ns, log_ns) in images.items():
        stamps_ns[camera] = np.where(by_header & (header_ns > 0), header_ns, log_ns + delay_ns)
        unset += int(np.count_nonzero((header_ns == 0) & (log_ns != 0))) if by_header else is_auto * len(log_ns)
    found = ImageStamps(stamps_ns, by_header, delay_ns, unset, [])
    if unset:
        found.warnings.append(
            f"used the times of logging for {unset} images: the stamps of their headers {fault or 'are 0'}"
        )
    # 3. Cameras whose clocks differ by less, and pauses.
    if by_header and apart_ns and 2 * apart_ns >= min(map(_step_ns, stamps_ns.values())):
        found.warnings.append(
            f"the clocks of the cameras differ by {apart_ns * 1e-9:.3f} s, half a period or more: images of different "
            'moments make pairs, which do not fit the rig; correct the clocks, or take log.time = "log"'
        )
    every = np.sort(np.concatenate([*stamps_ns.values()]))
    pauses_ns, longest_ns = np.diff(every), max(STEP_NS, _PAUSE * max(map(_step_ns, stamps_ns.values())))
    for at in np.flatnonzero(pauses_ns > longest_ns)[:1].tolist():
        number = np.count_nonzero(stamps_ns["lower"] <= every[at])
        found.warnings.append(
            f"{pauses_ns[at] * 1e-9:.1f} s without images after image {number}: a pause, or a clock that was set"
        )
    return found


def _header_fault(images: LoggedImages, *, is_logged: bool) -> str:
    """Return what is wrong with the headers of a camera; is_logged: the times of logging are in order."""
    # 1. The images in the order of logging, without repeated messages.
    order = np.argsort(images.log_ns, kind="stable") if is_logged else np.arange(len(images.log_ns))
    header_ns, log_ns = images.header_ns[order], images.log_ns[order]
    repeated = (np.diff(header_ns, prepend=-1) == 0) & (np.diff(log_ns, prepend=-1) == 0)
    header_ns, log_ns = header_ns[~repeated], log_ns[~repeated]
    is_set = header_ns > 0
    if np.count_nonzero(~is_set) > max(1, _FEW * len(is_set)):
        return "are 0"
    header_ns = header_ns[is_set]
    if fault := _fault(header_ns):
        return fault
    # 2. The times of logging show what lies before the first image, or behind most of them.
    if is_logged and _is_live(LoggedImages(header_ns, log_ns[is_set])):
        latest_ns = np.maximum.accumulate(header_ns)
        behind = header_ns < latest_ns - STEP_NS
        wrong = behind & ((header_ns < header_ns[0] - STEP_NS) | (np.mean(behind) > _MANY))
        return _running_back(latest_ns - header_ns, wrong)
    return ""


def _fault(times: Times) -> str:
    """Return why times, in their order, cannot be those at which a camera took its images; empty where they can."""
    if len(times) < 2:
        return ""
    if np.count_nonzero(np.diff(times) == 0) > max(1, _FEW * len(times)):
        return "do not advance"
    step_ns = _step_ns(times)
    if step_ns < _SHORTEST_STEP_NS:
        return f"are {step_ns / 1000:g} us apart"
    # An image behind the latest one must fill a hole: closer than half a period to others there is none.
    times = times[np.diff(times, prepend=-1) != 0]
    latest_ns = np.maximum.accumulate(times)
    order, place, counts = np.unique(times, return_inverse=True, return_counts=True)
    gaps_ns = np.diff(order).astype(np.float64)
    room_ns = np.minimum(np.append(np.inf, gaps_ns), np.append(gaps_ns, np.inf))
    is_crowded = (room_ns <= step_ns / 2) | (counts > 1)
    is_late = np.append(False, times[1:] <= latest_ns[:-1])
    return _running_back(latest_ns - times, is_late & is_crowded[place])


def _running_back(behind_ns: Times, wrong: NDArray[np.bool_]) -> str:
    """Return the fault of times of which some are wrong; empty where none is."""
    first = np.flatnonzero(wrong)[:1].tolist()
    return f"run back by {behind_ns[first[0]] * 1e-9:.3f} s at image {first[0] + 1}" if first else ""


def _is_live(images: LoggedImages) -> bool:
    """True if images were logged at about the rate of their headers, unlike by a conversion."""
    header_ns, log_ns = map(_step_ns, images)
    return header_ns < _FASTEST * log_ns and log_ns < _FASTEST * header_ns


def _delay_ns(images: LoggedImages) -> int:
    """Return the usual header minus time of logging; 0 without headers."""
    is_set = images.header_ns > 0
    return round(float(np.median((images.header_ns - images.log_ns)[is_set]))) if is_set.any() else 0


def _step_ns(times: Times) -> float:
    """Return the usual step between times, in any order; 0 of fewer than two."""
    return float(np.median(np.diff(np.sort(times)))) if len(times) > 1 else 0.0
