"""Stamps of the images of a log: by their headers, or by the times of logging where those cannot be used.

A camera driver stamps the header when the image is taken; the recorder logs the message when it arrives. Of the two
the header is the better one, unless it is not set, does not advance, or counts by another clock.

1. The first images decide for the whole log: their headers are used if they advance and both cameras share a clock.
2. An image whose header is not set, repeats the one before, or alone lies far from its time of logging has the time of
   logging, moved by the usual delay between both.
3. Where the headers step against the times of logging and run on regularly from there, a clock was set. The images
   after it are a new segment, whose stamps are moved so that time runs on, as the times of logging do (`running_on`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from drivers.frame import CAMERAS, Camera
from drivers.logs.log import LONGEST_STEP, ClockStep, running_on

TimeSource: TypeAlias = Literal["auto", "header", "log"]
Times: TypeAlias = NDArray[np.int64]

FIRST_IMAGES: Final = 8  # of a camera, by which the headers are judged; as many recent delays tell the usual one
SHORTEST_STEP_NS: Final = 1_000_000  # No camera takes 1,000 images a second, as stamps that hardly advance say.
STEP_NS: Final = 500_000_000  # Delays between header and logging change by less, unless a clock is set.
FASTEST: Final = 3.0  # After a step clocks and images run on, at rates that differ by less than this factor.
LOOKED_AHEAD: Final = 3  # images of a camera that tell a step of the clock from one wrong stamp
EPOCH_NS: Final = 10**18  # The year 2001: earlier stamps count from a start, as of the computer.


class LoggedImages(NamedTuple):
    """The N images of a camera in the order of logging."""

    header_ns: Times  # (N,) stamps of the headers, 0 where unset
    log_ns: Times  # (N,) times of logging, which run on
    repeats: NDArray[np.bool_]  # (N,) the image before has the same header and the same content


class ImageTimes:
    """The stamps of the images of both cameras, and what is wrong with their headers."""

    def __init__(
        self, images: Mapping[Camera, LoggedImages], source: TimeSource = "auto", log_steps: Sequence[ClockStep] = ()
    ) -> None:
        """log_steps: those of the times of logging."""
        self.by_log: Counter[str] = Counter()  # images with the time of logging, by what is wrong with their headers
        self._is_auto, self.source, self._steps = source == "auto", source, [*log_steps]
        # 1. What serves as the stamp.
        some = slice(FIRST_IMAGES)
        first = [LoggedImages(one.header_ns[some], one.log_ns[some], one.repeats[some]) for one in images.values()]
        fault, has_log = _judged([one for one in first if len(one.log_ns) > 1])
        if self._is_auto:
            self.source = "log" if fault and has_log else "header"
        self._is_old = self.source == "header" and any(
            0 < np.median(one.header_ns) < EPOCH_NS < one.log_ns.min() for one in first if len(one.log_ns)
        )
        # 2. The stamps.
        self.stamps_ns: dict[Camera, Times] = {camera: of_camera.log_ns for camera, of_camera in images.items()}
        self._shifts_ns, self._delay_ns = [0], 0  # of the lower camera
        if self.source == "log":
            self.by_log[fault] += sum(map(len, self.stamps_ns.values())) if self._is_auto else 0
        elif has_log:
            self._steps = []
            shared_ns: list[int] = []
            for camera, of_camera in images.items():
                times = _CameraTimes(of_camera, may_replace=self._is_auto, shared_ns=shared_ns)
                self.stamps_ns[camera] = times.stamps_ns
                self.by_log += times.faults
                self._steps += times.steps
                shared_ns += times.shifts_ns
                if camera == "lower":
                    self._shifts_ns, self._delay_ns = times.shifts_ns, times.delay_ns
            self._steps.sort()
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
        if self.source == "log" or not len(header_ns):
            return log_ns
        # Where a clock was set, the one of the samples may be the same.
        candidates_ns = header_ns + np.unique([0, *self._shifts_ns])[:, None]
        nearest = np.abs(candidates_ns - (log_ns + self._delay_ns)).argmin(axis=0)
        return np.where(header_ns > 0, candidates_ns[nearest, np.arange(len(header_ns))], log_ns)

    def warnings(self) -> Iterable[str]:
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


def _judged(cameras: Sequence[LoggedImages]) -> tuple[str, bool]:
    """Return what is wrong with all headers, by the first images of each camera, and whether the log times serve."""
    headers, logged = [images.header_ns for images in cameras], [images.log_ns for images in cameras]
    has_log = bool(cameras) and all(_step_ns(times) >= SHORTEST_STEP_NS for times in logged)
    delays_ns = [_median_ns(images.header_ns - images.log_ns) for images in cameras]
    if any(np.count_nonzero(header == 0) > len(header) / 2 for header in headers):
        return "are 0", has_log
    if any(_step_ns(header) < SHORTEST_STEP_NS for header in headers):
        return "do not advance", has_log
    if len(cameras) == len(CAMERAS) and abs(delays_ns[0] - delays_ns[1]) > STEP_NS and has_log:
        return f"are {abs(delays_ns[0] - delays_ns[1]) * 1e-9:.3f} s apart between the cameras", has_log
    # Times of logging that run at another rate, as those of a conversion, tell nothing about the headers.
    rates = [_step_ns(header) / max(1, _step_ns(log)) for header, log in zip(headers, logged, strict=True)]
    return "", has_log and all(1 / FASTEST < rate < FASTEST for rate in rates)


class _CameraTimes:
    """The stamps of one camera, whose times of logging serve.

    The delay, header minus time of logging, is constant up to the jitter of the recorder, which only makes it smaller;
    a clock that is set changes it at once, from one regular run of images to the next. A single other delay is that of
    a wrong header, unless the image was logged late, between others.
    """

    def __init__(self, images: LoggedImages, *, may_replace: bool, shared_ns: Iterable[int]) -> None:
        """may_replace: by the time of logging. shared_ns: shifts of the other camera, which may have the same clock."""
        header_ns, log_ns, repeats = images
        self.faults: Counter[str] = Counter()
        self.steps: list[ClockStep] = []
        self.shifts_ns, self.delay_ns = [0], 0  # from header to stamp; from time of logging to stamp
        # 1. Headers that are not set, or are those of another image.
        wrong = {"are 0": (header_ns == 0) & (log_ns != 0)}
        if may_replace:
            is_same = np.diff(header_ns, prepend=-1) == 0
            wrong["do not advance"] = is_same & ~repeats & (header_ns > 0)
        used = np.flatnonzero(~np.any([*wrong.values()], axis=0))
        header, log = header_ns[used], log_ns[used]
        delays, steps = header - log, np.diff(header)
        period = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
        # 2. Steps of the clock, before which and after which images are regular.
        is_regular = _regular(header, log, period)
        starts = [0]
        regular = np.flatnonzero(is_regular)
        jumps = (np.diff(header[regular]) < 0) | (np.diff(delays[regular]) > STEP_NS)
        begin = 0
        for at in (np.flatnonzero(jumps) + 1).tolist():
            before = delays[regular[max(begin, at - FIRST_IMAGES) : at]]
            after = delays[regular[at : at + LOOKED_AHEAD + 1]]
            usual, size_ns = np.median(before), round(np.median(after) - np.median(before))
            if abs(size_ns) <= max(period, np.ptp(before) + np.ptp(after)):
                continue
            between = delays[regular[at - 1] + 1 : regular[at] + 1]  # the last one of these is regular again
            first = int(regular[at - 1] + 1 + np.argmin(np.abs(between - usual) < np.abs(between - usual - size_ns)))
            shift_ns = self.shifts_ns[-1] - size_ns
            # Both cameras are moved alike where one clock was set.
            known = [other_ns for other_ns in shared_ns if abs(other_ns - shift_ns) < period / 2]
            if not known:
                self.steps.append(ClockStep(int(header[first - 1]) + self.shifts_ns[-1], size_ns))
            self.shifts_ns.append(known[0] if known else shift_ns)
            starts.append(int(used[first]))
            begin = at
        segment = np.searchsorted(starts, np.arange(len(header_ns)), "right") - 1
        stamps_ns = header_ns + np.array(self.shifts_ns)[segment]
        # 3. Delays that differ from those of all other images.
        if len(used):
            delays = stamps_ns[used] - log
            self.delay_ns = round(np.median(delays[is_regular] if is_regular.any() else delays))
            is_ahead, is_behind = _apart(delays, self.delay_ns)
            around = sliding_window_view(np.pad(delays, LOOKED_AHEAD, "reflect"), 2 * LOOKED_AHEAD + 1)
            gaps = np.pad(log, 1, "reflect", reflect_type="odd")
            is_alone = np.abs(np.median(around, axis=1) - self.delay_ns) < STEP_NS
            is_alone &= gaps[2:] - gaps[:-2] >= LONGEST_STEP * period
            is_alone[-LOOKED_AHEAD:] = False  # what follows them is not known
            for fault, is_so in (("lie ahead of the log", is_ahead), ("lie long before the log", is_behind & is_alone)):
                if may_replace:
                    wrong[fault] = np.isin(np.arange(len(header_ns)), used[is_so])
        # 4. The stamps.
        for fault, is_so in wrong.items():
            self.faults[fault] += int(np.count_nonzero(is_so))
        self.stamps_ns = np.where(np.any([*wrong.values()], axis=0), log_ns + self.delay_ns, stamps_ns)


def _regular(header: Times, log: Times, period: float) -> NDArray[np.bool_]:
    """Return which images (N,) are among four that were taken and logged one after the other, at about one rate."""
    found = np.zeros(len(header), np.bool_)
    if len(header) > LOOKED_AHEAD:
        passed, logged = (times[LOOKED_AHEAD:] - times[:-LOOKED_AHEAD] for times in (header, log))
        is_regular = sliding_window_view(np.diff(header) > 0, LOOKED_AHEAD).all(axis=1)
        is_regular &= passed < FASTEST * LOOKED_AHEAD * period
        is_regular &= (passed < FASTEST * logged) & (logged < FASTEST * passed)
        for n in range(LOOKED_AHEAD + 1):
            found[n : n + len(is_regular)] |= is_regular
    return found


def _apart(delays: Times, usual_ns: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which delays are larger and which are smaller than those about a usual one, with a gap of STEP_NS."""
    ascending = np.sort(delays)
    gaps, middle = np.flatnonzero(np.diff(ascending) > STEP_NS), np.searchsorted(ascending, usual_ns)
    low = ascending[max(gaps[gaps < middle], default=-1) + 1]
    high = ascending[min(gaps[gaps >= middle], default=len(delays) - 1)]
    return delays > high, delays < low


def _median_ns(times: Times) -> int:
    """Return the median, 0 of none."""
    return round(float(np.median(times))) if len(times) else 0


def _step_ns(times: Times) -> float:
    """Return the usual step between times, in any order; 0 of fewer than two."""
    return float(np.median(np.diff(np.sort(times)))) if len(times) > 1 else 0.0
