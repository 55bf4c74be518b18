"""Stamps of the images of a log: by their headers, or by the times of logging where those cannot be used.

A camera driver stamps the header when the image is taken; the recorder logs the message when it arrives. Of the two
the header is the better one, unless it is not set, does not advance, or counts by another clock.

1. The first images decide for the whole log: their headers are used if they advance and both cameras share a clock.
2. Headers run on, and never gain on the times of logging, as a recorder can only be late. Where they do, a run ends.
   Runs of some images that were taken and logged at about one rate are right: from one to the next the delay (header
   minus time of logging) changes where a clock was set. The images after it are a new segment, whose stamps are moved
   so that time runs on, as the times of logging do (`running_on`).
3. Of other images, those have the time of logging, moved by the usual delay, whose header is not set, repeats the one
   before, or lies far from that time; one that was logged late, between others, keeps its header. Where that is so
   for most images between two runs, or headers run back there, all of these have it: one clock for a stretch.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError
from drivers.frame import CAMERAS, Camera
from drivers.logs.log import FEWEST_IN_ORDER, LONGEST_STEP, ClockStep, Times, running_on

TimeSource: TypeAlias = Literal["auto", "header", "log"]

FIRST_IMAGES: Final = FEWEST_IN_ORDER  # by which the headers of a camera are judged, and the delays of a run
SHORTEST_STEP_NS: Final = 1_000_000  # No camera takes 1,000 images a second, as stamps that hardly advance say.
STEP_NS: Final = 500_000_000  # Delays between header and logging change by less, unless a clock is set.
FASTEST: Final = 3.0  # Clocks and images run on at rates that differ by less than this factor.
SHORTEST_RUN: Final = FIRST_IMAGES // 2  # images that tell a step of the clock from wrong stamps
EPOCH_NS: Final = 10**18  # The year 2001: earlier stamps count from a start, as of the computer.


class LoggedImages(NamedTuple):
    """The N images of a camera in the order of logging."""

    header_ns: Times  # stamps of the headers, 0 where unset
    log_ns: Times  # times of logging, which run on
    repeats: NDArray[np.bool_]  # (N,) the image before has the same header and the same content


class ImageTimes:
    """The stamps of the images of both cameras, and what is wrong with their headers."""

    def __init__(
        self, images: Mapping[Camera, LoggedImages], source: TimeSource = "auto", log_steps: Sequence[ClockStep] = ()
    ) -> None:
        """log_steps: those of the times of logging. DriverError where no camera can have taken the images so fast."""
        self.by_log: Counter[str] = Counter()  # images with the time of logging, by what is wrong with their headers
        self.stamps_ns: dict[Camera, Times] = {camera: of_camera.log_ns for camera, of_camera in images.items()}
        self._steps, self._shifts_ns, self._delay_ns = [*log_steps], {0}, 0  # the latter two of the lower camera
        self._apart_ns = 0.0  # clocks of the cameras, where it is half a period or more
        # 1. What serves as the stamp.
        some = slice(FIRST_IMAGES)
        first = [LoggedImages(one.header_ns[some], one.log_ns[some], one.repeats[some]) for one in images.values()]
        fault, has_log = _judged([one for one in first if len(one.log_ns) > 1])
        is_auto = source == "auto"
        step_ns = min((_step_ns(one.header_ns) for one in first), default=0.0)
        log_us = min((_step_ns(one.log_ns) for one in first), default=0.0) / 1000
        if is_auto and not has_log and 0 < step_ns < SHORTEST_STEP_NS:
            raise DriverError(
                f"the images are {step_ns / 1000:g} us apart by their headers, {log_us:g} us by the times of "
                'logging: were microseconds written as nanoseconds? log.time = "header" reads them as they are'
            )
        self._source = ("log" if fault and has_log else "header") if is_auto else source
        self._is_old = self._source == "header" and any(
            0 < one.header_ns.max() < EPOCH_NS < one.log_ns.min() for one in first if len(one.log_ns)
        )
        # 2. The stamps.
        if self._source == "log":
            self.by_log[fault] += sum(map(len, self.stamps_ns.values())) if is_auto else 0
        elif has_log:
            self._steps = []
            for camera in sorted(images):  # the lower one first, whose shifts are those of the upper one if it has them
                found = _Segments(images[camera], may_replace=is_auto, known_ns=self._shifts_ns)
                self.stamps_ns[camera] = found.stamps_ns
                self.by_log += found.faults
                self._steps += found.steps
                if camera == CAMERAS[0]:
                    self._shifts_ns, self._delay_ns = found.shifts_ns, found.delay_ns
            self._steps.sort()
            delays = [self.stamps_ns[camera] - images[camera].log_ns for camera in CAMERAS]
            if is_auto and min(map(len, delays)) > 1:  # A recorder can only be late: the least delay counts as well.
                apart_ns = min(abs(float(usual(delays[1]) - usual(delays[0]))) for usual in (np.median, np.max))
                self._apart_ns = apart_ns if 2 * apart_ns >= min(map(_step_ns, self.stamps_ns.values())) else 0.0
        else:
            # The times of logging say nothing: headers that step back run on by themselves.
            sizes = [len(images[camera].log_ns) for camera in CAMERAS]
            camera_of = np.repeat(np.arange(len(CAMERAS), dtype=np.int32), sizes)
            log_ns = np.concatenate([images[camera].log_ns for camera in CAMERAS])
            header_ns = np.concatenate([images[camera].header_ns for camera in CAMERAS])
            self.by_log["are 0"] += int(np.count_nonzero(header_ns == 0))
            header_ns = np.where(header_ns > 0, header_ns, log_ns)
            order = np.argsort(log_ns, kind="stable")
            run_ns, self._steps = running_on(camera_of[order], header_ns[order], range(len(CAMERAS)))
            for number, camera in enumerate(CAMERAS):
                self.stamps_ns[camera] = run_ns[camera_of[order] == number]
        starts = [int(stamps_ns[0]) for stamps_ns in self.stamps_ns.values() if len(stamps_ns)]
        self._first_ns = min(starts, default=0)

    def sample_ns(self, header_ns: Times, log_ns: Times) -> Times:
        """Return the stamps (N,) of samples of wheels or IMU by the clock of the images; log_ns: which run on."""
        if self._source == "log" or not len(header_ns):
            return log_ns
        # Where a clock was set, the one of the samples may be the same.
        return np.where(header_ns > 0, _shifted(header_ns, log_ns + self._delay_ns, {0, *self._shifts_ns}), log_ns)

    def warnings(self) -> Iterator[str]:
        """Yield one line for each fault of the stamps."""
        if self._is_old:
            yield (
                "the stamps of the images begin in 1970, as by a clock that counts from the start of the computer; "
                'log.time = "log" takes the times of logging'
            )
        if self.by_log.total():
            reasons = " or ".join(reason for reason, count in self.by_log.items() if count)
            yield f"used the times of logging for {self.by_log.total()} images: the stamps of their headers {reasons}"
        if self._steps:
            before_ns, size_ns = self._steps[0]
            way, at_s = "forward" if size_ns > 0 else "back", (before_ns - self._first_ns) * 1e-9
            more = f" ({len(self._steps) - 1} more steps follow)" if len(self._steps) > 1 else ""
            yield (
                f"the clock of the images was set {way} by {abs(size_ns) * 1e-9:.3f} s {at_s:.3f} s after the first "
                f"one{more}: the images after it are a new segment, whose stamps are moved so that time runs on"
            )
        if self._apart_ns:
            yield (
                f"the clocks of the cameras differ by {self._apart_ns * 1e-9:.3f} s, half a period or more: images of "
                'different moments make pairs, which do not fit the rig; correct the clocks, or take log.time = "log"'
            )
        lower, upper = (np.sort(self.stamps_ns[camera]) for camera in CAMERAS)
        steps_ns, period_ns = np.diff(lower), round(_step_ns(lower))
        is_empty = np.searchsorted(upper, lower[:-1] + period_ns) >= np.searchsorted(upper, lower[1:] - period_ns)
        for at in np.flatnonzero(is_empty & (steps_ns > max(STEP_NS, FIRST_IMAGES * period_ns)))[:1]:
            yield f"{steps_ns[at] * 1e-9:.1f} s without images after image {at + 1}: a pause, or a clock set forward"


def _judged(cameras: Sequence[LoggedImages]) -> tuple[str, bool]:
    """Return what is wrong with all headers, by the first images of each camera, and whether the log times serve."""
    headers, logged = [images.header_ns for images in cameras], [images.log_ns for images in cameras]
    has_log = bool(cameras) and all(_step_ns(times) >= SHORTEST_STEP_NS for times in logged)
    if any(np.count_nonzero(header == 0) > len(header) / 2 for header in headers):
        return "are 0", has_log
    if (step_ns := min(map(_step_ns, headers), default=SHORTEST_STEP_NS)) < SHORTEST_STEP_NS:
        return f"are {step_ns / 1000:g} us apart" if step_ns else "do not advance", has_log
    if has_log and any(_runs_back(header[header > 0]) for header in headers):
        return "run back", has_log
    delays_ns = [round(float(np.median((h - log)[h != 0]))) for h, log in zip(headers, logged, strict=True)]
    if len(cameras) == len(CAMERAS) and abs(delays_ns[0] - delays_ns[1]) > STEP_NS and has_log:
        return f"are {abs(delays_ns[0] - delays_ns[1]) * 1e-9:.3f} s apart between the cameras", has_log
    # Times of logging that run at another rate, as those of a conversion, tell nothing about the headers.
    rates = [_step_ns(header) / max(1, _step_ns(log)) for header, log in zip(headers, logged, strict=True)]
    return "", has_log and all(1 / FASTEST < rate < FASTEST for rate in rates)


class _Segments:
    """The stamps of one camera, whose times of logging serve: see the head of this file."""

    def __init__(self, images: LoggedImages, *, may_replace: bool, known_ns: set[int]) -> None:
        """may_replace: by the time of logging. known_ns: shifts of the other camera, which may have the same clock."""
        header_ns, log_ns, repeats = images
        self.steps: list[ClockStep] = []
        # 1. Headers that are not set, or are those of another image.
        wrong = {"are 0": (header_ns == 0) & (log_ns != 0)}
        if may_replace:
            wrong["do not advance"] = (np.diff(header_ns, prepend=-1) == 0) & ~repeats & (header_ns > 0)
        used = np.flatnonzero(~np.any([*wrong.values()], axis=0))
        header, log = header_ns[used], log_ns[used]
        delays, increments = header - log, np.diff(header)
        period = float(np.median(increments[increments > 0])) if np.any(increments > 0) else 0.0
        # 2. Runs, and the shift of each that is regular.
        cuts = np.flatnonzero((increments < 0) | (np.diff(delays) > STEP_NS)) + 1
        runs = [slice(*ends) for ends in pairwise([0, *cuts.tolist(), len(header)])]
        regular = [run for run in runs if _is_regular(header[run], log[run])]
        shifts, is_regular, shift_ns = np.zeros(len(header), np.int64), np.zeros(len(header), np.bool_), 0
        for before, run in zip([None, *regular], regular, strict=False):
            if before is not None:
                old, new = delays[before][-FIRST_IMAGES:], delays[run][:FIRST_IMAGES]
                size_ns = round(np.median(new) - np.median(old))
                if abs(size_ns) > max(period, np.ptp(old) + np.ptp(new)):
                    # Both cameras are moved alike where one clock was set.
                    moved_ns = shift_ns - size_ns
                    known = next((other_ns for other_ns in known_ns if abs(other_ns - moved_ns) < period / 2), None)
                    if known is None:
                        self.steps.append(ClockStep(int(header[before.stop - 1]) + shift_ns, size_ns))
                    shift_ns = moved_ns if known is None else known
            shifts[run], is_regular[run] = shift_ns, True
        self.shifts_ns = {*shifts[is_regular].tolist()}
        stamps = header + shifts
        lateness = (stamps - log)[is_regular] if regular else delays
        self.delay_ns = round(float(np.median(lateness))) if len(lateness) else 0
        # 3. Other images: the shift that fits best. What is far behind was logged late, unless
        # its place among the others is its own in the log, or is taken by the stamps.
        stamps[~is_regular] = _shifted(header, log + self.delay_ns, {*self.shifts_ns} or {0})[~is_regular]
        if may_replace and len(log):
            apart, around = stamps - log - self.delay_ns, np.pad(log_ns, 1, "reflect", reflect_type="odd")
            is_alone = (around[2:] - around[:-2] >= LONGEST_STEP * period)[used]
            is_alone[1 - SHORTEST_RUN :] = False  # what follows them is not known
            # No image was taken long before the first one, nor within half a period of another.
            taken = np.append(np.sort(stamps[is_regular]), [np.iinfo(np.int64).max])
            is_taken = taken[np.searchsorted(taken, stamps - round(period / 2))] < stamps + period / 2
            is_taken |= stamps < taken[0] - LONGEST_STEP * period
            usual = min(STEP_NS, max(period, 2 * np.ptp(lateness))) if regular else STEP_NS
            is_ahead = ~is_regular & (apart > usual)
            is_before = ~is_regular & (((apart < -STEP_NS) & is_alone) | ((apart < -usual) & is_taken))
            replaced, is_mixed = is_ahead | is_before, np.zeros(len(log), np.bool_)
            mixed = np.where(replaced, log + self.delay_ns, stamps)
            for begin, end in np.flatnonzero(np.diff(is_regular, prepend=True, append=True)).reshape(-1, 2):
                part = slice(begin, end)
                is_most = np.mean(replaced[part]) >= 1 / 2 or _runs_back(header[part])
                is_mixed[part] = is_most and replaced[part].any() and (np.diff(mixed[part]) < 0).any()
            for fault, is_so in (("lie ahead of the log", is_ahead), ("lie long before the log", is_before)):
                wrong[fault] = np.isin(np.arange(len(header_ns)), used[is_so & ~is_mixed])
            wrong["run back or jump"] = np.isin(np.arange(len(header_ns)), used[is_mixed])
        # 4. The stamps.
        self.faults = Counter({fault: int(np.count_nonzero(is_so)) for fault, is_so in wrong.items()})
        self.stamps_ns = log_ns + self.delay_ns
        self.stamps_ns[used] = stamps
        is_wrong = np.any([*wrong.values()], axis=0)
        self.stamps_ns[is_wrong] = log_ns[is_wrong] + self.delay_ns


def _is_regular(header: Times, log: Times) -> bool:
    """True for a run of images that were taken and logged at about one rate."""
    if len(header) < SHORTEST_RUN:
        return False
    taken_ns, logged_ns = int(header[-1] - header[0]), int(log[-1] - log[0])
    return taken_ns < FASTEST * logged_ns and logged_ns < FASTEST * taken_ns


def _runs_back(times: Times) -> bool:
    """True for times, in the order of logging, most of which are before the one before."""
    return len(times) > 1 and bool(np.median(np.diff(times)) < 0 and times[-1] < times[0])


def _shifted(header_ns: Times, expected_ns: Times, shifts_ns: set[int]) -> Times:
    """Return the headers (N,), each moved by that of the shifts which brings it nearest to the expected time."""
    candidates_ns = header_ns + np.array(sorted(shifts_ns), np.int64)[:, None]
    nearest = np.abs(candidates_ns - expected_ns).argmin(axis=0)
    return np.asarray(candidates_ns[nearest, np.arange(len(header_ns))])


def _step_ns(times: Times) -> float:
    """Return the usual step between times, in any order; 0 of fewer than two."""
    return float(np.median(np.diff(np.sort(times)))) if len(times) > 1 else 0.0
