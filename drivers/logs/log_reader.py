"""Reads the frames of two cameras, and samples of wheels and IMU, from a log: MCAP, bags of ROS, folders of images."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError, FrameDecodeError
from drivers.frame import CAMERAS, Camera, Frame
from drivers.logs.open_log import open_log
from drivers.logs.ros_messages import IMU
from drivers.logs.stamps import STEP_NS, ImageStamps, LoggedImages, TimeSource, image_stamps
from drivers.logs.topics import MotionChoice, MotionTopics, choose_motion_topics, choose_topics
from drivers.motion import MotionSample, WheelSample

_WARNINGS = {
    "duplicate": "dropped {} frames with the same stamp as the frame before of the same camera",
    "broken_motion": "skipped {} messages of wheels or IMU that are not valid; the first: {fault}",
    "no_joints": "none of {} messages of joints names the wheels: see motion.wheel_joints",
    "broken": "skipped {} messages of the cameras' topics that hold no valid image; the first: {fault}",
    "broken_records": "skipped {} corrupt chunks or records of the file; the first: {fault}",
}
_COUNTERS = ("lower", "upper", "unstamped", "repeated", "unreadable", *_WARNINGS)
WHOLE = (0.0, math.inf)  # span of all of a log [s]


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
    their names do not identify the cameras. span_s: the part of the log that is read, from and until so many seconds
    after the stamp of its first image. motion: topics of wheels and IMU; None: their samples are not read. time: which
    of its two times an image is stamped with, see `image_stamps`. Raises DriverError where the path is no such log, or
    the topics of the two cameras are ambiguous.

    The headers of all messages are read first, so that the order is that of the stamps, whatever that of the file.

    During and after frames() and messages(), `counts` has 'lower' and 'upper' (frames delivered), 'duplicate',
    'repeated' (of these, with the same content), 'unstamped' (time of logging used), 'broken' (messages without a valid
    image), 'unreadable' (images in corrupt chunks or records), 'broken_motion' and 'broken_records' (chunks or records
    of the file). After its end `truncated` is True for an incomplete log, and `warnings` has one line per kind of
    fault.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        lower: str | None = None,
        upper: str | None = None,
        *,
        span_s: tuple[float, float] = WHOLE,
        motion: MotionTopics | None = None,
        bits: int = 16,
        rate_hz: float = 0.0,
        time: TimeSource = "auto",
    ) -> None:
        self._closed, self._span_s, self._bits, self._time = False, span_s, bits, time
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
        cameras: dict[str, Camera] = {topic: camera for camera, topic in self._cameras.items()}
        is_image, stamps_ns = self._order.is_image, self._order.stamps_ns
        first_ns = int(stamps_ns[is_image][0]) if is_image.any() else 0
        at_s = 1e-9 * np.where(is_image, stamps_ns - first_ns, np.maximum(stamps_ns - first_ns, 0))
        begin_s, end_s = self._span_s
        if is_image.any() and at_s.max() < begin_s:
            raise DriverError(
                f"{self._log.name!r} ends {at_s.max():.1f} s after its first image: a start before that was "
                f"expected, {begin_s:g} s found"
            )
        last: dict[Camera, Frame] = {}
        # Samples behind the last image are of no use.
        inside = (at_s >= begin_s) & (at_s <= min(end_s, at_s[is_image].max(initial=0.0)))
        for row, stamp_ns, of_camera in zip(
            *(part[inside].tolist() for part in (self._order.rows, stamps_ns, is_image)), strict=True
        ):
            message = self._log.message(row)
            if self._closed:
                return
            if message is None:
                self.counts["unreadable"] += of_camera
                continue
            camera = cameras.get(message.topic)
            try:
                if camera is None:
                    sample = message.motion(self._joints)
                    self._has_wheels |= isinstance(sample, WheelSample)
                    self._other_joints += sample is None
                    if sample is not None:
                        yield replace(sample, stamp_ns=stamp_ns)
                    continue
                image = replace(message.image(), stamp_ns=stamp_ns, camera=camera, bits=self._bits)
            except FrameDecodeError as error:
                counter = "broken" if camera else "broken_motion"
                self.counts[counter] += 1
                self._faults.setdefault(counter, str(error))
                continue
            # A copy, so that a frame that is held back does not keep its chunk in memory.
            image = replace(image, seq=self.counts[camera], data=memoryview(bytes(image.data)))
            before = last.get(camera)
            if before is not None and stamp_ns == before.stamp_ns:
                self.counts["duplicate"] += 1
                self.counts["repeated"] += before.data == image.data
                continue
            last[camera] = image
            self.counts[camera] += 1
            yield image
        if not self._closed:
            self._report()

    @cached_property
    def _order(self) -> _Order:
        """The messages of the cameras, the wheels and the IMU, in the order of their stamps."""
        log, names = self._log, [*self._log.topics()]
        rows = np.sort(log.rows({*self._cameras.values(), *self._motion.names}))  # in the order of the files
        topic, entries = log.index.topic[rows], log.index.entries[rows]
        log_ns, header_ns = entries["time_ns"], entries["header_ns"]
        # 1. The stamps.
        at_of = {camera: np.flatnonzero(topic == names.index(name)) for camera, name in self._cameras.items()}
        images = {camera: LoggedImages(header_ns[at], log_ns[at]) for camera, at in at_of.items()}
        try:
            times = image_stamps(images, self._time)
        except DriverError as error:
            raise DriverError(f"{log.name!r}: {error}") from None
        stamps_ns, rank = log_ns.copy(), np.zeros(len(rows), np.int64)
        for number, camera in enumerate(CAMERAS, 1):
            stamps_ns[at_of[camera]], rank[at_of[camera]] = times.stamps_ns[camera], number
        is_image = rank > 0
        stamps_ns[~is_image] = times.sample_ns(header_ns[~is_image], log_ns[~is_image])
        stamps_of = {name: stamps_ns[topic == number] for number, name in enumerate(names)}
        spans = {name: (int(ns.min()), int(ns.max())) for name, ns in stamps_of.items() if ns.size}
        # 2. The order: of one stamp samples, the lower camera, the upper one.
        order = np.lexsort((rank, stamps_ns))
        return _Order(rows[order], stamps_ns[order], is_image[order], times, spans)

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
        self._faults: dict[str, str] = {}  # by counter: what is wrong with the first message that is not valid
        self._other_joints = 0  # messages of joints without the wheels
        self._has_wheels = False

    def _of_another_clock(self) -> Iterator[str]:
        """Yield a warning for cameras, and for wheels or gyro, whose stamps are shifted against each other."""
        spans, topics = self._order.spans_ns, self._log.topics()
        images = [spans[topic] for camera in CAMERAS if (topic := self._cameras[camera]) in spans]
        if len(images) == len(CAMERAS):
            begin_ns, end_ns = (upper_ns - lower_ns for lower_ns, upper_ns in zip(*images, strict=True))
            if min(abs(begin_ns), abs(end_ns)) > STEP_NS > abs(begin_ns - end_ns):
                yield (
                    f"the images of the upper camera begin and end {_apart(begin_ns)} those of the lower one by their "
                    "stamps: of another clock?"
                )
        for topic in sorted(self._motion.names & spans.keys()) if images else ():
            begin_ns, end_ns = spans[topic]
            if begin_ns > max(last_ns for _, last_ns in images) or end_ns < min(images)[0]:
                yield (
                    f"no sample of the {'gyro' if topics[topic] == IMU else 'wheels'} is used: they begin "
                    f"{_apart(begin_ns - min(images)[0])} the images by their stamps: are these of another clock?"
                )

    def _report(self) -> None:
        damage, times = self._log.damage(), self._order.times
        self.truncated = bool(damage.cut)
        self.counts["broken_records"] = damage.broken
        topics = self._cameras.values()
        self.counts["unstamped"] = times.by_log
        if self._span_s == WHOLE:
            self.counts["unreadable"] += sum(self._log.index.lost.get(topic, 0) for topic in topics)
        self.counts["no_joints"] = 0 if self._has_wheels else self._other_joints
        self._faults["broken_records"] = damage.first
        self.warnings += [damage.cut] if damage.cut else []
        for name, text in _WARNINGS.items():
            if self.counts[name]:
                self.warnings.append(text.format(self.counts[name], fault=self._faults.get(name, "")))
        self.warnings += [*times.warnings, *self._of_another_clock()]


class _Order(NamedTuple):
    """The N messages that are read, by their stamps."""

    rows: NDArray[np.int64]  # (N,) of the log
    stamps_ns: NDArray[np.int64]  # (N,)
    is_image: NDArray[np.bool_]  # (N,)
    times: ImageStamps
    spans_ns: Mapping[str, tuple[int, int]]  # topic -> first and last stamp


def _apart(shift_ns: int) -> str:
    return f"{abs(shift_ns) * 1e-9:.1f} s {'after' if shift_ns > 0 else 'before'}"
