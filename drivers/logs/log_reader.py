"""Reads the frames of two cameras, and samples of wheels and IMU, from a log: MCAP, bags of ROS, folders of images."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError, FrameDecodeError
from drivers.frame import CAMERAS, Camera, Frame
from drivers.logs.open_log import open_log
from drivers.logs.streams import (
    MotionTopics,
    TimeSource,
    choose_motion_topics,
    choose_topics,
    stamp_rule,
)
from drivers.motion import MotionSample

_WARNINGS = {
    "duplicate": "dropped {} frames with the same stamp as the frame before of the same camera",
    "broken_motion": "skipped {} messages of wheels or IMU that are not valid; the first: {fault}",
    "broken": "skipped {} messages of the cameras' topics that hold no valid image; the first: {fault}",
    "broken_records": "skipped {} corrupt chunks or records of the file; the first: {fault}",
}
_COUNTERS = ("lower", "upper", "repeated", "unreadable", *_WARNINGS)
WHOLE = (0.0, math.inf)  # span of all of a log [s]


class LogCameras(NamedTuple):
    """Which images of a log are those of the cameras, and how they are read: the arguments of LogReader."""

    lower: str | None = None  # topics; None: identified by their names
    upper: str | None = None
    bits: int = 16
    rate_hz: float = 0.0
    time: TimeSource = "auto"

    def reader(
        self,
        path: str | os.PathLike[str],
        rig_topics: tuple[str, str] = ("", ""),
        span_s: tuple[float, float] = WHOLE,
        motion: MotionTopics | None = None,
    ) -> LogReader:
        """Open a log; rig_topics: those that a rig states, which count where none are named and the log has them."""
        bits, rate_hz, time = self.bits, self.rate_hz, self.time

        def opened(lower: str | None, upper: str | None) -> LogReader:
            return LogReader(path, lower, upper, span_s=span_s, motion=motion, bits=bits, rate_hz=rate_hz, time=time)

        if not (self.lower and self.upper) and all(rig_topics):
            with suppress(DriverError):  # the topics may have been renamed since the rig was calibrated
                return opened(self.lower or rig_topics[0], self.upper or rig_topics[1])
        return opened(self.lower, self.upper)


# Both topics, or more.
AnyCameras: TypeAlias = tuple[str | None, str | None] | LogCameras


class LogReader:
    """A FrameSource that streams a log once per call of frames().

    path, rate_hz: as for `open_log`. bits: of the samples of images of 16 bits, see Frame. lower, upper: topics, where
    their names do not identify the cameras. span_s: the part of the log that is read, from and until so many seconds
    after the stamp of its first image. motion: topics of wheels and IMU; None: their samples are not read. time: which
    of its two times a message is stamped with, see `stamp_rule`. Raises DriverError where the path is no such log, or
    the topics of the two cameras are ambiguous.

    topics: of the cameras. During and after frames() and messages(), `counts` has 'lower' and 'upper' (frames
    delivered), 'duplicate', 'repeated' (of these, with the same content), 'broken' (messages without a valid image),
    'unreadable' (images in corrupt chunks or records), 'broken_motion' and 'broken_records' (chunks or records of the
    file). After its end `truncated` is True for an incomplete log, and `warnings` has one line per kind of fault.
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
        self._motion, self._motion_warnings = set[str](), list[str]()
        try:
            name, topics = repr(str(self._log.path)), self._log.topics
            self.topics: dict[Camera, str] = choose_topics(name, topics, {"lower": lower, "upper": upper})
            if motion is not None:
                self._motion, self._motion_warnings = choose_motion_topics(name, topics, motion)
            self._reset()
        except DriverError as error:
            cut = self._log.cut
            self.close()
            raise DriverError(f"{error}; {cut}" if cut else str(error)) from error

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of both cameras in the order of their stamps; seq counts each camera's from 0."""
        return (message for message in self.messages() if isinstance(message, Frame))

    def messages(self) -> Iterator[Frame | MotionSample]:
        """Yield frames, and samples of wheels and IMU, in the order of their stamps."""
        self._reset()
        cameras: dict[str, Camera] = {topic: camera for camera, topic in self.topics.items()}
        rows, stamps_ns, is_image, warnings = self._order
        # 1. The part that is read, from the first image to the last one: samples behind it are of no use.
        first_ns = int(stamps_ns[is_image].min(initial=stamps_ns.max(initial=0)))
        at_s = 1e-9 * np.where(is_image, stamps_ns - first_ns, np.maximum(stamps_ns - first_ns, 0))
        begin_s, end_s = self._span_s
        last_s = at_s[is_image].max(initial=0.0)
        if is_image.any() and last_s < begin_s:
            raise DriverError(
                f"{str(self._log.path)!r} ends {last_s:.1f} s after its first image: a start before that was expected, "
                f"{begin_s:g} s found"
            )
        inside = (at_s >= begin_s) & (at_s <= min(end_s, last_s))
        # 2. Its messages.
        last, used = dict[Camera, Frame](), set[str]()
        read = (part[inside].tolist() for part in (rows, stamps_ns, is_image))
        for row, stamp_ns, of_camera in zip(*read, strict=True):
            message = self._log.message(row)
            if self._closed:
                return
            if message is None:
                self.counts["unreadable"] += of_camera
                continue
            camera = cameras.get(message.topic)
            try:
                if camera is None:
                    sample = message.motion()
                    used.update([message.topic] if stamp_ns >= first_ns else [])
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
        # 3. What was wrong.
        if not self._closed:
            self._report(warnings, self._motion - used)

    @cached_property
    def _order(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_], list[str]]:
        """The messages of the cameras, the wheels and the IMU, in the order of their stamps.

        Rows of the log (N,), stamps [ns] (N,), whether each is an image (N,), and warnings about the stamps.
        """
        log = self._log
        rows = log.rows({*self.topics.values(), *self._motion})
        entries, names = log.entries[rows], [*log.topics]
        of_camera = {camera: log.topic[rows] == names.index(self.topics[camera]) for camera in CAMERAS}
        header_ns, log_ns = entries["header_ns"], entries["time_ns"]
        images = {camera: (header_ns[of_it], log_ns[of_it]) for camera, of_it in of_camera.items()}
        try:
            rule = stamp_rule(images, self._time)
        except DriverError as error:
            raise DriverError(f"{str(log.path)!r}: {error}") from None
        stamps_ns = rule.stamps_ns(header_ns, log_ns)
        # Of one stamp samples come first, then the lower camera, then the upper one.
        rank = of_camera["lower"] + 2 * of_camera["upper"]
        order = np.lexsort((rank, stamps_ns))
        return rows[order], stamps_ns[order], rank[order] > 0, rule.warnings

    def close(self) -> None:
        """End frames() and close the log."""
        self._closed = True
        self._log.close()

    def pair_estimate(self) -> int | None:
        """Return the largest possible number of pairs, for a progress bar; None where the log is read in part."""
        if self._span_s != WHOLE:
            return None
        counts = self._log.counts()
        return min(counts[topic] for topic in self.topics.values())

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments, such as a rig; up to 16 MiB each."""
        return self._log.attachments()

    def _reset(self) -> None:
        self.counts: Counter[str] = Counter(dict.fromkeys(_COUNTERS, 0))
        self.warnings: list[str] = [*self._motion_warnings]
        self.truncated = False
        self._faults: dict[str, str] = {}  # by counter: what is wrong with the first message that is not valid

    def _report(self, warnings: list[str], unused: set[str]) -> None:
        """Complete the counters and warnings; unused: topics of wheels and IMU that gave no sample."""
        faults, cut = self._log.faults, self._log.cut
        self.truncated = bool(cut)
        self.counts["broken_records"] = len(faults)
        self._faults["broken_records"] = "".join(faults[:1])
        if self._span_s == WHOLE:
            self.counts["unreadable"] += sum(self._log.lost[topic] for topic in self.topics.values())
        self.warnings += [cut] if cut else []
        for name, text in _WARNINGS.items():
            if self.counts[name]:
                self.warnings.append(text.format(self.counts[name], fault=self._faults.get(name, "")))
        self.warnings += warnings
        self.warnings += [
            f"no sample of {topic} is used: by its stamps it is not of the time of the images: is it of another clock?"
            for topic in sorted(unused)
            if self._log.counts()[topic]
        ]
