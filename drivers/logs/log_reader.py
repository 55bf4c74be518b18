"""Reads the frames of two cameras, and samples of wheels and IMU, from a log: MCAP, bags of ROS, folders of images."""

from __future__ import annotations

import heapq
import math
import os
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError, FrameDecodeError
from drivers.frame import CAMERAS, SAMPLE_BITS, Camera, Frame, gray, is_deep
from drivers.logs.image_times import MAX_HELD_BYTES, STEP_NS, ImageTimes, TimedImage, TimeSource
from drivers.logs.log import LoggedMessage
from drivers.logs.open_log import open_log
from drivers.logs.ros_messages import RosImage
from drivers.logs.topics import MotionChoice, MotionTopics, choose_motion_topics, choose_topics
from drivers.motion import MotionSample, WheelSample

_WARNINGS = {
    "late": "dropped {} frames older than others read before, by more than 32 images: record with less delay",
    "duplicate": "dropped {} frames with the same stamp as the frame before of the same camera",
    "carried": "{} stamps have 10^9 nanoseconds or more, which were added to their seconds",
    "broken_motion": "skipped {} messages of wheels or IMU that are not valid; the first: {motion_fault}",
    "no_joints": "none of {} messages of joints names the wheels: see motion.wheel_joints",
    "broken": "skipped {} messages of the cameras' topics that hold no valid image; the first: {fault}",
    "broken_records": "skipped {} corrupt chunks or records of the file; the first: {record_fault}",
}
MAX_WAITING_SAMPLES = 65_536  # Samples of wheels and IMU that wait for the next images: some minutes.
MOST_PERCENT = 99.0
NEUTRAL_GREY, NEAR_NEUTRAL = 128, 16  # grey levels of colourless U and V, and how near those of weak colours are
_COUNTERS = ("lower", "upper", "unstamped", "repeated", *_WARNINGS)
WHOLE = (0.0, math.inf)  # span of all of a log [s]
# Stamp, rank (0: a sample; 1, 2: of the lower and of the upper camera), number of the arrival, item.
_Entry: TypeAlias = tuple[int, int, int, RosImage | MotionSample]


class LogCameras(NamedTuple):
    """Which images of a log are those of the cameras, and how they are read: the arguments of LogReader."""

    lower: str | None = None  # topics; None: identified by their names
    upper: str | None = None
    bits: int = 16
    rate_hz: float = 0.0
    time: TimeSource = "auto"

    def reader(self, path: str | os.PathLike[str]) -> LogReader:
        """Open a log."""
        return LogReader(path, self.lower, self.upper, bits=self.bits, rate_hz=self.rate_hz, time=self.time)


# Both topics, or more.
AnyCameras: TypeAlias = tuple[str | None, str | None] | LogCameras


class LogReader:
    """A FrameSource that streams a log once per call of frames().

    path, rate_hz: as for `open_log`. bits: of the samples of images of 16 bits, see Frame. lower, upper: topics, where
    their names do not identify the cameras. window: number of frames that are held back to sort them by stamp. span_s:
    the part of the log that is read, from and until so many seconds after the stamp of its first image. motion: topics
    of wheels and IMU; None: their samples are not read. time: which of its two times an image is stamped with, see
    `image_times`. Raises DriverError where the path is no such log, or the topics of the two cameras are ambiguous.

    During and after frames() and messages(), `counts` has 'lower' and 'upper' (frames delivered), 'late', 'duplicate',
    'repeated' (of these, with the same content), 'unstamped' (time of logging used), 'broken' (messages without a valid
    image), 'broken_motion' and 'broken_records' (chunks or records of the file). After its end `truncated` is True for
    an incomplete log, and `warnings` has one line per kind of fault.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        lower: str | None = None,
        upper: str | None = None,
        *,
        window: int = 32,
        span_s: tuple[float, float] = WHOLE,
        motion: MotionTopics | None = None,
        bits: int = 16,
        rate_hz: float = 0.0,
        time: TimeSource = "auto",
    ) -> None:
        self._window, self._closed, self._span_s, self._bits, self._time = window, False, span_s, bits, time
        self._log = open_log(path, rate_hz)
        self._motion = MotionChoice(frozenset())
        self._joints = motion.joints if motion else None
        try:
            wanted: dict[Camera, str | None] = {"lower": lower, "upper": upper}
            topics = self._log.topics()
            self._cameras = choose_topics(repr(self._log.name), topics, wanted)
            if motion is not None:
                self._motion = choose_motion_topics(repr(self._log.name), topics, motion)
            self._reset()
        except DriverError as error:
            cut = self._log.damage().cut
            self.close()
            raise DriverError(f"{error}; {cut}" if cut else str(error)) from error

    @property
    def topics(self) -> dict[Camera, str]:
        """The topic of each camera."""
        return dict(self._cameras)

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of both cameras in the order of their stamps; seq counts each camera's from 0."""
        return (message for message in self.messages() if isinstance(message, Frame))

    def messages(self) -> Iterator[Frame | MotionSample]:
        """Yield frames, and samples of wheels and IMU, in the order of their stamps."""
        self._reset()
        begin_s, end_s = self._span_s
        first_ns, at_s = None, 0.0
        for stamp_ns, rank, _, item in self._in_order():
            first_ns = stamp_ns if first_ns is None and rank else first_ns
            at_s = 0.0 if first_ns is None else 1e-9 * (stamp_ns - first_ns)
            if at_s > end_s:
                break
            if at_s < begin_s:
                continue
            if isinstance(item, RosImage):
                camera = CAMERAS[rank - 1]
                self.counts[camera] += 1
                yield item.frame(camera, self.counts[camera] - 1, self._bits)
            else:
                yield item
        if first_ns is not None and at_s < begin_s:
            raise DriverError(
                f"{self._log.name!r} ends {at_s:.1f} s after its first image: a start before that was "
                f"expected, {begin_s:g} s found"
            )
        if not self._closed:
            self._report()

    def _in_order(self) -> Iterator[_Entry]:
        """Yield images and samples by stamp; the newest images are held back, as their times of logging may differ.

        An image that is late, or is there twice, is counted instead.
        """
        waiting, newest_ns, last = _Waiting(), 0, dict[int, RosImage]()
        timed: TimedImage | None
        for timed in chain(self._times.stamped(self._images()), [None]):
            # 1. Samples that were logged before an image wait with it.
            while self._unstamped and (timed is None or self._unstamped[0][0] <= timed.log_ns):
                log_ns, sample = self._unstamped.popleft()
                stamp_ns = self._times.sample_ns(sample.stamp_ns, log_ns)
                self._widen("wheels" if isinstance(sample, WheelSample) else "gyro", stamp_ns)
                waiting.add(stamp_ns, 0, replace(sample, stamp_ns=stamp_ns))
            if timed is not None:
                for what in ("images", timed.camera):
                    self._widen(what, timed.image.stamp_ns)
                waiting.add(timed.image.stamp_ns, 1 + CAMERAS.index(timed.camera), timed.image)
            # 2. The earliest ones.
            while not self._closed and waiting.frames and (timed is None or waiting.is_full(self._window)):
                entry = waiting.take()
                stamp_ns, rank, _, item = entry
                if isinstance(item, RosImage):
                    before = last.get(rank)
                    if before is not None and before.stamp_ns == stamp_ns:
                        self.counts["duplicate"] += 1
                        self.counts["repeated"] += before.data == item.data
                        continue
                    if stamp_ns < newest_ns:
                        self.counts["late"] += 1
                        continue
                    newest_ns, last[rank] = stamp_ns, item
                yield entry

    def _images(self) -> Iterator[TimedImage]:
        """Yield the images in the order of logging; the samples between them wait."""
        cameras = {topic: camera for camera, topic in self._cameras.items()}
        for message in self._log.messages({*cameras, *self._motion.names}):
            if self._closed:
                return
            if message.topic in cameras:
                image = self._image(message)
                if image is not None:
                    yield TimedImage(cameras[message.topic], image, message.run_ns)
            elif (sample := self._sample(message)) is not None:
                self._unstamped.append((message.run_ns, sample))

    def close(self) -> None:
        """End frames() and close the log."""
        self._closed = True
        self._log.close()

    def pair_estimate(self) -> int | None:
        """Return the largest possible number of pairs, for a progress bar; None where the log is read in part."""
        if self._span_s != WHOLE:
            return None
        counts = self._log.counts()
        return min(counts.get(topic, 0) for topic in self._cameras.values())

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments, such as a rig; up to 16 MiB each, 64 MiB in all."""
        return self._log.attachments()

    def _reset(self) -> None:
        self.counts: Counter[str] = Counter(dict.fromkeys(_COUNTERS, 0))
        self.warnings: list[str] = [self._motion.warning] if self._motion.warning else []
        self.truncated = False
        self._examined: set[str] = set()  # topics whose first image was
        self._fault = ""  # of the first message without a valid image
        self._motion_fault = ""  # of the first message of wheels or IMU that is not valid
        self._other_joints = 0  # messages of joints without the wheels
        self._spans: dict[str, tuple[int, int]] = {}  # first and last stamp of images, each camera, wheels and gyro
        self._times = ImageTimes(self._time, self._log.clock_steps())
        # Samples with their times of logging; no stage waits for more.
        self._unstamped: deque[tuple[int, MotionSample]] = deque(maxlen=MAX_WAITING_SAMPLES)

    def _image(self, logged: LoggedMessage) -> RosImage | None:
        """Return an image, None of a broken one.

        The image is copied out of its chunk, so that a frame that is held back does not keep the chunk in memory.
        """
        try:
            image = logged.image()
            self._examine(logged.topic, image)
        except FrameDecodeError as error:
            self.counts["broken"] += 1
            self._fault = self._fault or str(error)
            return None
        self.counts["carried"] += image.carries
        return replace(image, data=memoryview(bytes(image.data)))

    def _examine(self, topic: str, image: RosImage) -> None:
        """Warn where the first image of a topic would be black, or grey, as it is encoded otherwise than stated."""
        if topic in self._examined:
            return
        self._examined.add(topic)
        frame = image.frame(bits=self._bits)
        with suppress(FrameDecodeError):  # who decodes the image says what is wrong with it
            if image.width and _is_neutral(gray(frame)):
                self.warnings.append(
                    f"the first image of {topic!r} ({image.encoding!r}) has grey levels near {NEUTRAL_GREY} only, as "
                    "colours have in YUV: is its encoding right? yuv422 is UYVY, yuv422_yuy2 is YUYV"
                )
            if self._bits == SAMPLE_BITS[-1] and is_deep(frame) and gray(frame).max() < 2**12 >> 8:
                self.warnings.append(
                    f"the first image of {topic!r} has samples of 16 bits, none above {2**12 - 1}: of a camera of 10 "
                    "or 12 bits? State cameras.bits, or --bits"
                )

    def _sample(self, logged: LoggedMessage) -> MotionSample | None:
        """Return the sample in a message of wheels or IMU, None of a broken one, and of joints without the wheels."""
        try:
            sample = logged.motion(self._joints)
        except FrameDecodeError as error:
            self.counts["broken_motion"] += 1
            self._motion_fault = self._motion_fault or str(error)
            return None
        self._other_joints += sample is None
        return sample

    def _widen(self, what: str, stamp_ns: int) -> None:
        first_ns, last_ns = self._spans.get(what, (stamp_ns, stamp_ns))
        self._spans[what] = min(first_ns, stamp_ns), max(last_ns, stamp_ns)

    def _of_another_clock(self) -> Iterator[str]:
        """Yield a warning for cameras, and for wheels or gyro, whose stamps are shifted against each other."""
        images, both = self._spans.get("images"), [self._spans.get(camera) for camera in CAMERAS]
        if both[0] and both[1]:
            begin_ns, end_ns = (upper_ns - lower_ns for lower_ns, upper_ns in zip(*both, strict=True))
            if min(abs(begin_ns), abs(end_ns)) > STEP_NS > abs(begin_ns - end_ns):
                yield (
                    f"the images of the upper camera begin and end {abs(begin_ns) * 1e-9:.1f} s "
                    f"{'after' if begin_ns > 0 else 'before'} those of the lower one by their stamps: of another clock?"
                )
        for what in ("wheels", "gyro"):
            span = self._spans.get(what)
            if images and span and (span[0] > images[1] or span[1] < images[0]):
                apart_s = 1e-9 * (span[0] - images[0])
                yield (
                    f"no sample of the {what} is used: they begin {abs(apart_s):.1f} s "
                    f"{'after' if apart_s > 0 else 'before'} the images by their stamps: are these of another clock?"
                )

    def _report(self) -> None:
        damage = self._log.damage()
        self.counts["broken_records"] = damage.broken
        self.truncated = bool(damage.cut)
        if damage.cut:
            self.warnings.append(damage.cut)
        self.counts["unstamped"] = self._times.by_log.total()
        self.counts["no_joints"] = 0 if "wheels" in self._spans else self._other_joints
        found = {name: text for name, text in _WARNINGS.items() if self.counts[name]}
        faults = {"fault": self._fault, "motion_fault": self._motion_fault, "record_fault": damage.first}
        self.warnings += [text.format(self.counts[name], **faults) for name, text in found.items()]
        self.warnings += [*self._times.warnings(), *self._of_another_clock()]


def _is_neutral(image: NDArray[np.uint8]) -> bool:
    """True if nearly all grey levels (H, W) are near the middle."""
    return bool(np.percentile(np.abs(image.astype(np.int16) - NEUTRAL_GREY), MOST_PERCENT) <= NEAR_NEUTRAL)


class _Waiting:
    """Images and samples, the earliest first: of one stamp samples, the lower camera, the upper one, by arrival."""

    def __init__(self) -> None:
        self._entries: list[_Entry] = []
        self.frames = self._arrivals = self._bytes = 0

    def add(self, stamp_ns: int, rank: int, item: RosImage | MotionSample) -> None:
        """Add an entry. The data of an image must not change afterwards."""
        heapq.heappush(self._entries, (stamp_ns, rank, self._arrivals, item))
        self._arrivals += 1
        if isinstance(item, RosImage):
            self.frames, self._bytes = self.frames + 1, self._bytes + len(item.data)

    def take(self) -> _Entry:
        """Take the earliest entry."""
        entry = heapq.heappop(self._entries)
        if isinstance(entry[-1], RosImage):
            self.frames, self._bytes = self.frames - 1, self._bytes - len(entry[-1].data)
        return entry

    def is_full(self, window: int) -> bool:
        """True with more than `window` images, too many bytes of them, or more samples than a stage could wait for."""
        samples = len(self._entries) - self.frames
        return self.frames > window or self._bytes > MAX_HELD_BYTES or samples > MAX_WAITING_SAMPLES
