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

from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.frame import CAMERAS, Camera
from drivers.logs.log import LATEST_NS, LONGEST_STEP, ClockStep, running_on

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
        self._log_ns, self._shift_ns = np.zeros(1, np.int64), np.zeros(1, np.int64)  # shifts of the lower camera
        self._delay_ns = 0
        if self.source == "log":
            self.by_log[fault] += sum(map(len, self.stamps_ns.values())) if self._is_auto else 0
        elif has_log:
            self._steps = []
            shifts: set[int] = set()
            for camera, of_camera in images.items():
                times = _CameraTimes(of_camera, may_replace=self._is_auto, shifts=shifts)
                self.stamps_ns[camera] = times.stamps_ns
                self.by_log += times.faults
                self._steps += times.steps
                shifts |= set(times.shifts_ns)
                if camera == "lower":
                    self._log_ns, self._shift_ns = of_camera.log_ns, np.array(times.shifts_ns, np.int64)
                    self._delay_ns = _median_ns(times.delays_ns)
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
        at = np.searchsorted(self._log_ns, log_ns, "right").clip(1, len(self._log_ns)) - 1
        expected_ns = log_ns + self._delay_ns + self._shift_ns[at]
        candidates_ns = header_ns + np.unique(np.append(self._shift_ns, 0))[:, None]
        nearest = np.abs(candidates_ns - expected_ns).argmin(axis=0)
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
    """The stamps of one camera, whose times of logging serve."""

    def __init__(self, images: LoggedImages, *, may_replace: bool, shifts: Iterable[int]) -> None:
        """may_replace: by the time of logging. shifts: of the other camera, which may share the clock [ns]."""
        self._headers, self._logged = images.header_ns.tolist(), images.log_ns.tolist()
        self._all_ns = [header - log for header, log in zip(self._headers, self._logged, strict=True)]
        self.faults: Counter[str] = Counter()
        self.steps: list[ClockStep] = []
        self.shifts_ns: list[int] = []  # from header to stamp
        self.delays_ns: deque[int] = deque(maxlen=FIRST_IMAGES)  # header minus log time of images that are not late
        self._periods_ns: deque[int] = deque(maxlen=FIRST_IMAGES)  # between headers
        self._newest_ns, self._least_ns = 0, -LATEST_NS  # latest header of the segment; least delay of logging in it
        shift_ns, stamps = 0, list[int]()
        for n, (header_ns, log_ns) in enumerate(zip(self._headers, self._logged, strict=True)):
            before_ns = self._headers[n - 1] if n else 0
            usual_ns = _median_ns(self.delays_ns or [d for d, h in self._behind(n) if h])
            fault = ""
            # 1. A header that is not set, or is that of another image.
            if not header_ns and log_ns:
                fault = "are 0"
            elif may_replace and n and header_ns == before_ns and not images.repeats[n]:
                fault = "do not advance" if header_ns else ""
            # 2. A step of the clock, after which it runs on; else a time that is far from those of all other images.
            elif size_ns := self._step_ns(n):
                half_ns = _median_ns(self._periods_ns) / 2
                shift_ns -= size_ns
                # Both cameras are moved alike where one clock was set.
                shared = [other_ns for other_ns in shifts if abs(other_ns - shift_ns) < half_ns]
                if not shared:
                    self.steps.append(ClockStep(stamps[-1], size_ns))
                shift_ns = shared[0] if shared else shift_ns
                self._newest_ns, self._least_ns = 0, -LATEST_NS
                self.delays_ns.clear()
            elif may_replace and (self._is_ahead(n) or self._is_alone(n)):
                fault = "lie ahead of the log" if self._all_ns[n] > usual_ns else "lie long before the log"
            if fault:
                self.faults[fault] += 1
            # 3. Late images tell nothing about the usual delay.
            elif header_ns >= self._newest_ns:
                self._newest_ns = header_ns
                self.delays_ns.append(self._all_ns[n])
                self._least_ns = max(self._least_ns, self._all_ns[n])
            stamps.append((log_ns + usual_ns if fault else header_ns) + shift_ns)
            self.shifts_ns.append(shift_ns)
            if 0 < before_ns < header_ns:
                self._periods_ns.append(header_ns - before_ns)
        self.stamps_ns = np.array(stamps, np.int64)

    def _behind(self, n: int) -> list[tuple[int, int]]:
        """Return delay and header of the images behind one."""
        some = slice(n + 1, n + 1 + LOOKED_AHEAD)
        return list(zip(self._all_ns[some], self._headers[some], strict=True))

    def _is_ahead(self, n: int) -> bool:
        """True if a header has jumped to a time long after that of logging: no image is logged before it is taken."""
        latest_ns = max(self._newest_ns, self._logged[n] + self._least_ns)
        return bool(self.delays_ns and self._headers[n] > latest_ns + STEP_NS)

    def _is_alone(self, n: int) -> bool:
        """True if the header of an image lies far from its time of logging, and those of all others do not.

        An image that was delivered late is logged between others, which are as far apart as always.
        """
        behind = [delay_ns for delay_ns, _ in self._behind(n)]
        if len(behind) < LOOKED_AHEAD:
            return False
        if n and self._logged[n + 1] - self._logged[n - 1] < LONGEST_STEP * _median_ns(self._periods_ns):
            return False
        others_ns = [*self.delays_ns, *behind]
        apart_ns = min(abs(self._all_ns[n] - other_ns) for other_ns in others_ns)
        return bool(max(others_ns) - min(others_ns) < STEP_NS < apart_ns)

    def _step_ns(self, n: int) -> int:
        """Return by how much a clock was set before an image; 0 where it was not."""
        headers, logged = (times[n : n + 1 + LOOKED_AHEAD] for times in (self._headers, self._logged))
        if len(headers) < 2 or not self.delays_ns or not (headers[0] < self._newest_ns or self._is_ahead(n)):
            return 0
        # Late images go back as well, but they are logged all at once, or are few, or the next one is not late.
        passed_ns, logged_ns = headers[-1] - headers[0], max(1, logged[-1] - logged[0])
        period_ns = _median_ns(self._periods_ns)
        is_usual = passed_ns < FASTEST * (len(headers) - 1) * (period_ns or passed_ns)
        if headers != sorted(set(headers)) or not is_usual or not 1 / FASTEST < passed_ns / logged_ns < FASTEST:
            return 0
        usual_ns = _median_ns(self.delays_ns)
        sizes_ns = [delay_ns - usual_ns for delay_ns in self._all_ns[n : n + 1 + LOOKED_AHEAD]]
        size_ns = _median_ns(sizes_ns)
        least_ns = max(period_ns, sum(max(some) - min(some) for some in (self.delays_ns, sizes_ns)))
        return size_ns if all(abs(each) > least_ns and each * size_ns > 0 for each in sizes_ns) else 0


def _median_ns(times: Iterable[int]) -> int:
    """Return the median, 0 of none."""
    found = list(times)
    return round(median(found)) if found else 0


def _step_ns(times: Times) -> float:
    """Return the usual step between times, in any order; 0 of fewer than two."""
    return float(np.median(np.diff(np.sort(times)))) if len(times) > 1 else 0.0
