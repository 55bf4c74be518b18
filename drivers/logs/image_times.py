"""Stamps of the images of a log: by their headers, or by the times of logging where those cannot be used.

A camera driver stamps the header when the image is taken; the recorder logs the message when it arrives. Of the two
the header is the better one, unless it is not set, does not advance, or counts by another clock.

1. The first images decide for the whole log: their headers are used if they advance and both cameras share a clock.
2. Afterwards an image whose header is not set, repeats the one before, or alone lies far from its time of logging has
   the time of logging, moved by the usual delay between both.
3. Where the headers step against the times of logging and run on regularly from there, a clock was set. The images
   after it are a new segment, whose stamps are moved so that time runs on, as the times of logging do (`Log`).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from statistics import median
from typing import Final, Literal, TypeAlias

from drivers.frame import CAMERAS, Camera
from drivers.logs.log import LATEST_NS, LONGEST_STEP, ClockStep
from drivers.logs.ros_messages import RosImage

TimeSource: TypeAlias = Literal["auto", "header", "log"]

FIRST_IMAGES: Final = 16  # of both cameras, by which the headers are judged
MAX_HELD_BYTES: Final = 256 * 2**20  # of the images that wait for later ones
SHORTEST_STEP_NS: Final = 1_000_000  # No camera takes 1,000 images a second, as stamps that hardly advance say.
STEP_NS: Final = 500_000_000  # Delays between header and logging change by less, unless a clock is set.
FASTEST: Final = 3.0  # After a step clocks and images run on, at rates that differ by less than this factor.
LOOKED_AHEAD: Final = 3  # images of a camera that tell a step of the clock from one wrong stamp
DELAYS: Final = 8  # recent delays, whose median is the usual one
EPOCH_NS: Final = 10**18  # The year 2001: earlier stamps count from a start, as of the computer.


@dataclass(frozen=True, slots=True)
class TimedImage:
    """An image of a camera with both its times."""

    camera: Camera
    image: RosImage  # its stamp is that of the header, 0 if unset
    log_ns: int  # LoggedMessage.run_ns

    @property
    def delay_ns(self) -> int:
        """The header minus the time of logging: negative where an image was logged after it was taken."""
        return self.image.stamp_ns - self.log_ns


@dataclass(slots=True)
class _CameraTimes:
    """What is known of the times of one camera."""

    before: TimedImage | None = None  # the last image
    stamp_ns: int = 0  # of it, as delivered
    newest_ns: int = 0  # latest header of the segment
    shift_ns: int = 0  # from headers to stamps, after steps of the clock
    delays_ns: deque[int] = field(default_factory=lambda: deque(maxlen=DELAYS))  # of images that are not late
    least_delay_ns: int = -LATEST_NS  # the largest of them in the segment: no image is logged before it is taken
    periods_ns: deque[int] = field(default_factory=lambda: deque(maxlen=DELAYS))  # between headers

    def is_ahead(self, image: TimedImage) -> bool:
        """True if the header has jumped to a time long after that of logging."""
        latest_ns = max(self.newest_ns, image.log_ns + self.least_delay_ns)
        return bool(self.delays_ns) and image.image.stamp_ns > latest_ns + STEP_NS

    def is_alone(self, first: TimedImage, behind: Sequence[TimedImage]) -> bool:
        """True if the header of an image lies far from its time of logging, and those of all others do not.

        An image that was delivered late is logged between others, which are as far apart as always.
        """
        if len(behind) < LOOKED_AHEAD:
            return False
        period_ns = _median_ns(self.periods_ns)
        if self.before is not None and behind[0].log_ns - self.before.log_ns < LONGEST_STEP * period_ns:
            return False
        others_ns = [*self.delays_ns, *(each.delay_ns for each in behind)]
        apart_ns = min(abs(first.delay_ns - other_ns) for other_ns in others_ns)
        return max(others_ns) - min(others_ns) < STEP_NS < apart_ns

    def step_ns(self, first: TimedImage, behind: Sequence[TimedImage]) -> int:
        """Return by how much a clock was set before an image; 0 where it was not."""
        if not (behind and self.delays_ns and (first.image.stamp_ns < self.newest_ns or self.is_ahead(first))):
            return 0
        # Late images go back as well, but they are logged all at once, or are few, or the next one is not late.
        images = [first, *behind]
        headers = [each.image.stamp_ns for each in images]
        passed_ns, logged_ns = headers[-1] - headers[0], max(1, images[-1].log_ns - first.log_ns)
        period_ns = _median_ns(self.periods_ns)
        is_usual = passed_ns < FASTEST * len(behind) * (period_ns or passed_ns)
        if headers != sorted(set(headers)) or not is_usual or not 1 / FASTEST < passed_ns / logged_ns < FASTEST:
            return 0
        usual_ns = _median_ns(self.delays_ns)
        sizes_ns = [each.delay_ns - usual_ns for each in images]
        size_ns = _median_ns(sizes_ns)
        least_ns = max(period_ns, sum(max(some) - min(some) for some in (self.delays_ns, sizes_ns)))
        return size_ns if all(abs(each) > least_ns and each * size_ns > 0 for each in sizes_ns) else 0


class ImageTimes:
    """Stamps the images of a log; `source` is header or log once the first images have decided."""

    def __init__(self, source: TimeSource = "auto", log_steps: Sequence[ClockStep] = ()) -> None:
        """log_steps: those of the times of logging."""
        self.source: TimeSource = source
        self.by_log: Counter[str] = Counter()  # images with the time of logging, by what is wrong with their headers
        self._is_auto, self._has_log = source == "auto", False  # has_log: the times of logging advance
        self._cameras: dict[Camera, _CameraTimes] = {camera: _CameraTimes() for camera in CAMERAS}
        self._log_steps = log_steps
        self._steps: list[ClockStep] = []  # of the headers
        self._first_ns: int | None = None
        self._fault = ""  # of the headers, where the times of logging are used for all images
        self._is_old = False  # the headers count from the start of the computer

    def stamped(self, images: Iterable[TimedImage]) -> Iterator[TimedImage]:
        """Yield the images, which come in the order of logging, with the stamps that are used."""
        waiting: deque[TimedImage] = deque()
        for image in images:
            waiting.append(image)
            while len(waiting) >= FIRST_IMAGES or sum(len(each.image.data) for each in waiting) > MAX_HELD_BYTES:
                yield self._next(waiting)
        while waiting:
            yield self._next(waiting)

    def sample_ns(self, header_ns: int, log_ns: int) -> int:
        """Return the stamp of a sample of wheels or IMU, by the clock of the images; log_ns: LoggedMessage.run_ns."""
        if self.source == "log" or not header_ns:
            return log_ns
        lower = self._cameras["lower"]
        expected_ns = log_ns + _median_ns(lower.delays_ns) + lower.shift_ns
        shifts = (0, *(times.shift_ns for times in self._cameras.values())) if self._steps else (0,)
        return min((header_ns + shift_ns for shift_ns in shifts), key=lambda stamp_ns: abs(stamp_ns - expected_ns))

    def warnings(self) -> Iterator[str]:
        """Yield one line for each fault of the stamps."""
        if self._is_old:
            yield (
                "the stamps of the images begin in 1970, as by a clock that counts from the start of the computer; "
                'log.time = "log" takes the times of logging'
            )
        if self.by_log:
            reasons = " or ".join(self.by_log)
            yield f"used the times of logging for {self.by_log.total()} images: the stamps of their headers {reasons}"
        steps = self._log_steps if self.source == "log" else self._steps
        if steps:
            way = "forward" if steps[0].size_ns > 0 else "back"
            at_s = (steps[0].before_ns - (self._first_ns or 0)) * 1e-9
            more = f" ({len(steps) - 1} more steps follow)" if len(steps) > 1 else ""
            yield (
                f"the clock of the images was set {way} by {abs(steps[0].size_ns) * 1e-9:.3f} s {at_s:.3f} s after the "
                f"first one{more}: the images after it are a new segment, whose stamps are moved so that time runs on"
            )

    def _decide(self, first: Iterable[TimedImage]) -> None:
        """Choose the times for the whole log by its first images."""
        of_cameras = [[each for each in first if each.camera == camera] for camera in CAMERAS]
        of_cameras = [images for images in of_cameras if len(images) > 1]
        headers = [[each.image.stamp_ns for each in images] for images in of_cameras]
        logged = [[each.log_ns for each in images] for images in of_cameras]
        delays = [_median_ns(each.delay_ns for each in images) for images in of_cameras]
        self._has_log = bool(logged) and all(_step_ns(times) >= SHORTEST_STEP_NS for times in logged)
        if any(header.count(0) > len(header) / 2 for header in headers):
            self._fault = "are 0"
        elif any(_step_ns(header) < SHORTEST_STEP_NS for header in headers):
            self._fault = "do not advance"
        elif len(delays) == len(CAMERAS) and abs(delays[0] - delays[1]) > STEP_NS:
            self._fault = f"are {abs(delays[0] - delays[1]) * 1e-9:.3f} s apart between the cameras"
        else:  # Times of logging that run at another rate, as those of a conversion, tell nothing about the headers.
            rates = [_step_ns(header) / max(1, _step_ns(log)) for header, log in zip(headers, logged, strict=True)]
            self._has_log = self._has_log and all(1 / FASTEST < rate < FASTEST for rate in rates)
        self.source = "log" if self._is_auto and self._fault and self._has_log else self.source
        self.source = "header" if self.source == "auto" else self.source
        is_old = 0 < _median_ns(stamp_ns for header in headers for stamp_ns in header) < EPOCH_NS
        self._is_old = is_old and self.source == "header" and all(min(times) > EPOCH_NS for times in logged)

    def _next(self, waiting: deque[TimedImage]) -> TimedImage:
        """Take the first of the images that wait, and stamp it with regard to those behind it."""
        if self._first_ns is None:
            self._decide(waiting)
        first = waiting.popleft()
        times = self._cameras[first.camera]
        stamp_ns = self._stamp_ns(times, first, [each for each in waiting if each.camera == first.camera])
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        if times.before is not None and 0 < times.before.image.stamp_ns < first.image.stamp_ns:
            times.periods_ns.append(first.image.stamp_ns - times.before.image.stamp_ns)
        times.before, times.stamp_ns = first, stamp_ns
        return replace(first, image=replace(first.image, stamp_ns=stamp_ns))

    def _stamp_ns(self, times: _CameraTimes, first: TimedImage, behind: Sequence[TimedImage]) -> int:
        """Return the stamp of an image; behind: the next images of its camera."""
        if self.source == "log":
            if self._is_auto:
                self.by_log[self._fault] += 1
            return first.log_ns
        behind, before, header_ns = behind[:LOOKED_AHEAD], times.before, first.image.stamp_ns
        usual_ns = _median_ns(times.delays_ns or [each.delay_ns for each in behind if each.image.stamp_ns])
        may_replace, fault = self._is_auto and self._has_log, ""
        # 1. A header that is not set, or is that of another image.
        if not header_ns and first.log_ns:
            fault = "are 0"
        elif may_replace and before and header_ns == before.image.stamp_ns and first.image.data != before.image.data:
            fault = "do not advance" if header_ns else ""
        # 2. A step of the clock, after which it runs on; else a time that is far from those of all other images.
        elif self._has_log and (size_ns := times.step_ns(first, behind)):
            self._move(times, size_ns)
        elif may_replace and (times.is_ahead(first) or times.is_alone(first, behind)):
            fault = "lie ahead of the log" if first.delay_ns > usual_ns else "lie long before the log"
        if fault:
            self.by_log[fault] += 1
            return first.log_ns + usual_ns + times.shift_ns
        # 3. Late images tell nothing about the usual delay.
        if header_ns >= times.newest_ns:
            times.newest_ns = header_ns
            times.delays_ns.append(first.delay_ns)
            times.least_delay_ns = max(times.least_delay_ns, first.delay_ns)
        return header_ns + times.shift_ns

    def _move(self, times: _CameraTimes, size_ns: int) -> None:
        """Begin a segment, whose stamps continue those before; both cameras are moved alike where one clock was set."""
        shift_ns = times.shift_ns - size_ns
        others = [other.shift_ns for other in self._cameras.values() if other is not times]
        shift_ns = next(
            (other for other in others if abs(other - shift_ns) < _median_ns(times.periods_ns) / 2), shift_ns
        )
        if shift_ns not in others:
            self._steps.append(ClockStep(times.stamp_ns, size_ns))
        times.shift_ns, times.newest_ns, times.least_delay_ns = shift_ns, 0, -LATEST_NS
        times.delays_ns.clear()


def _median_ns(times: Iterable[int]) -> int:
    """Return the median, 0 of none."""
    found = list(times)
    return round(median(found)) if found else 0


def _step_ns(times: Sequence[int]) -> float:
    """Return the usual step between times, in any order."""
    return median(after - before for before, after in pairwise(sorted(times)))
