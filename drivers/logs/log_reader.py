"""Opens logs of any kind; reads the frames of two cameras, and samples of wheels and IMU, from them.

The format follows from the first bytes, or from what a folder contains: MCAP, bags of ROS, folders of images.
Which topics are those of the cameras, the wheels and the IMU follows from names and types. A camera driver stamps the
header when the image is taken; the recorder logs the message when it arrives. The headers are better, and are used
unless some are not set. Times that run back are refused: `log.time` says which are used.
"""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError, FrameDecodeError
from drivers.frame import CAMERAS, Camera, Frame
from drivers.logs.bags import Ros1Bag, SqliteBag
from drivers.logs.image_folder import STAMP_LISTS, ImageFolder, image_folders
from drivers.logs.log import Log, LogFile, listed
from drivers.logs.mcap_file import McapFile
from drivers.logs.ros_messages import COMPRESSED_IMAGE, IMAGE, IMAGE_TYPES, IMU, ODOMETRY, parse_image, parse_motion
from drivers.motion import MotionSample

LOG_SUFFIXES: Final = (".mcap", ".db3", ".bag")
# A log: name, time of its first message (of omnid's recordings and of ROS 1), number of the part, format.
_NAME: Final = re.compile(
    r"(?P<name>.+?)(?:_\d{8}T\d{6}Z|_\d{4}(?:-\d{2}){5})?(?:_(?P<part>\d{1,9}))?(?P<format>\.(?:mcap|db3|bag))"
)
_FORMATS: Final = (McapFile, SqliteBag, Ros1Bag)


def is_log_name(name: str) -> bool:
    """True if a file is a log by its name."""
    return _NAME.fullmatch(name) is not None


def open_log(path: str | os.PathLike[str]) -> Log:
    """Open a log. Raise DriverError, which names the supported kinds, for anything else.

    path: an MCAP file, an SQLite bag of ROS 2 (.db3), a bag of ROS 1 (.bag), a folder with one of these or with the
    parts of one, or a folder with a folder of images for each camera.
    """
    given = Path(path)
    parts = [given]
    if given.is_dir():
        try:
            logs = logs_in(given)
            parts = parts_in_order(logs)
            folders = [] if logs else image_folders(given)
        except OSError as error:
            raise DriverError(f"cannot read the folder {str(given)!r}: {error.strerror}") from error
        if folders:
            return Log(given, [ImageFolder(given, folders)])
        if not parts:
            raise DriverError(
                f"{str(given)!r} must contain one log ({' '.join(LOG_SUFFIXES)}, unpacked), the numbered parts of one, "
                f"or a folder of images for each camera; found: {listed((log.name for log in logs), 'none')}; give one "
                "file"
            )
    with ExitStack() as opened:
        files = [opened.enter_context(closing(_open_file(part))) for part in parts]
        log = Log(given, files)
        opened.pop_all()
    return log


def _open_file(path: Path) -> LogFile:
    """Open a log by its first bytes."""
    start = b""
    try:
        if not path.exists() or path.is_file():  # a pipe would be waited for
            with path.open("rb") as file:
                start = file.read(max(len(kind.magic) for kind in _FORMATS))
    except OSError as error:
        raise DriverError(f"cannot read the log {str(path)!r}: {error.strerror}") from error
    for kind in _FORMATS:
        if start.startswith(kind.magic):
            return kind(path)
    found = f"it starts with {start!r}" if start else "it is empty, or no regular file"
    raise DriverError(
        f"{str(path)!r} is no log: {found}: give one of {', '.join(LOG_SUFFIXES)}, unpacked if it was compressed"
    )


def logs_in(folder: Path) -> list[Path]:
    """Return the logs in a folder by their names. Raise OSError where it is unreadable."""
    return [file for file in sorted(folder.iterdir()) if is_log_name(file.name) and file.is_file()]


def files_in(folder: Path) -> Iterator[Path]:
    """Yield the files of a folder that are read as a log or as images; none where it is no folder."""
    boards = tuple(f"{camera}_" for camera in CAMERAS)
    for file in folder.glob("*"):
        if is_log_name(file.name) or file.name in STAMP_LISTS or file.name.startswith(boards):
            yield file
    for images in image_folders(folder):
        yield from images.iterdir()


def parts_in_order(logs: list[Path]) -> list[Path]:
    """Return the parts of a log in the order of their numbers, none where the files are not such parts.

    Parts have one name and consecutive numbers: `bag_0.mcap`, `bag_1.mcap`, as `ros2 bag record` names them. A single
    log is its only part.
    """
    matches = [(log, match) for log in logs if (match := _NAME.fullmatch(log.name))]
    found = {int(match["part"] or -1): log for log, match in matches}
    numbers, names = sorted(found), {(match["name"], match["format"]) for _, match in matches}
    if len(names) != 1 or numbers != list(range(numbers[0], numbers[0] + len(logs))) or (numbers[0] < 0 and logs[1:]):
        return []
    return [found[number] for number in numbers]


Times: TypeAlias = NDArray[np.int64]  # (N,) [ns]
TimeSource: TypeAlias = Literal["auto", "header", "log"]

_WORDS: dict[str, Camera] = {
    **dict.fromkeys(("lower", "bottom", "down"), "lower"),
    **dict.fromkeys(("upper", "top", "up"), "upper"),
}
_COMPRESSED = "/compressed"  # ends the names of compressed images (image_transport)
_SHORTEST_STEP_NS: Final = 1_000_000  # No camera takes 1,000 images a second: these are stamps in microseconds.


def choose_topics(
    log: str, topics: Mapping[str, str], wanted: tuple[str | None, str | None], rig: tuple[str, str] = ("", "")
) -> dict[Camera, str]:
    """Return the topics of the two cameras.

    log: its name for error messages. topics: name -> type. wanted: requested topics of lower and upper, which must
    exist; a camera without one has that which the rig states, if both are there: they may have been renamed since it
    was calibrated; else it is identified by a word of its topic's name. Raises DriverError, which lists the candidates,
    where the choice is ambiguous.
    """
    images = [name for name, kind in topics.items() if kind in IMAGE_TYPES and not name.endswith("/compressedDepth")]
    if not images:
        raise DriverError(
            f"no image topics in {log}: found {listed(topics, 'no messages')}; record {IMAGE} or {COMPRESSED_IMAGE} of "
            "both cameras; `omnid log info` says whether the log was cut"
        )

    def transports(name: str) -> list[str]:
        """Return the topics of an image, which image_transport publishes raw, compressed, or both."""
        return [each for each in (name, f"{name}{_COMPRESSED}", name.removesuffix(_COMPRESSED)) if each in images]

    by_rig = [name or stated for name, stated in zip(wanted, rig, strict=True)]
    names = by_rig if all(name and transports(name) for name in by_rig) else wanted
    found: dict[Camera, str] = {}
    for camera, name in zip(CAMERAS, names, strict=True):
        mine = transports(name)[:1] if name else [topic for topic in images if _camera_of(topic) == camera]
        if len({topic.removesuffix(_COMPRESSED) for topic in mine}) != 1:
            named = f"{'several' if mine else 'no'} topics named after the {camera} camera"
            problem = f"no topic {name!r} of images" if name else named
            raise DriverError(f"{problem} in {log}: found {listed(images)}; give --lower and --upper")
        found[camera] = max(mine, key=lambda topic: topic.endswith(_COMPRESSED))
    if found["lower"] == found["upper"]:
        raise DriverError(f"topic {found['lower']!r} of {log} is named for both cameras: expected two topics")
    return found


def _camera_of(topic: str) -> Camera | None:
    """Return the camera of the first word that names one: /upper/down_sampled is of the upper camera."""
    return next((_WORDS[word] for word in re.split(r"[^a-z0-9]+", topic.lower()) if word in _WORDS), None)


class MotionTopics(NamedTuple):
    """Topics of wheels and of an IMU; None: chosen by name and type; empty: none."""

    wheels: str | None = None
    imu: str | None = None


def choose_motion_topics(log: str, topics: Mapping[str, str], wanted: MotionTopics) -> tuple[set[str], list[str]]:
    """Return the topics of wheels and IMU; where several might be meant, none, and a warning.

    A topic of odometry is that of wheels if its name contains "wheel", because others are results. Raises
    DriverError for a requested topic that does not exist or is of another type.
    """
    chosen, warnings = set[str](), list[str]()
    for kind, name, setting in ((ODOMETRY, wanted.wheels, "motion.wheels"), (IMU, wanted.imu, "motion.imu")):
        if name and topics.get(name) != kind:
            raise DriverError(f"{name!r} is no topic of {kind} in {log}; {setting} must be one: {listed(topics)}")
        of_kind = [topic for topic, found in topics.items() if found == kind and name in (None, topic)]
        names = of_kind if name or kind == IMU else [topic for topic in of_kind if "wheel" in topic.lower()]
        if len(names) > 1:
            warnings.append(f"{log} has several topics of {kind}: {listed(names)}; none is used: set {setting}")
        else:
            chosen.update(names)
    return chosen, warnings


def choose_stamps(
    header_ns: Times, log_ns: Times, of_camera: Mapping[Camera, NDArray[np.bool_]], source: TimeSource
) -> tuple[Times, str]:
    """Return the stamps (N,) of messages in the order of the file, and a warning where headers are not set.

    header_ns: stamps of their headers, 0 where unset, -1 where cut; log_ns: times of logging; of_camera: which are
    images of a camera. By "auto", raise DriverError where those of a camera do not advance, or are too close.
    """
    # 1. Headers, unless some are not set.
    is_unset = (header_ns == 0) & (log_ns != 0) & np.logical_or(of_camera["lower"], of_camera["upper"])
    by_header = source == "header" or (source == "auto" and not is_unset.any())
    stamps_ns = np.where(by_header & (header_ns > 0), header_ns, log_ns)
    if source != "auto":
        return stamps_ns, ""
    # 2. Times that are wrong.
    for is_image in of_camera.values():
        known = is_image & (header_ns >= 0)
        steps_ns, is_repeated = np.diff(stamps_ns[known]), np.diff(log_ns[known]) == 0
        wrong = np.flatnonzero((steps_ns < 0) | ((steps_ns == 0) & ~is_repeated)).tolist()
        step_ns = np.median(steps_ns[steps_ns > 0]) if (steps_ns > 0).any() else _SHORTEST_STEP_NS
        if wrong or step_ns < _SHORTEST_STEP_NS:
            back = f"run back by {-steps_ns[wrong[0]] * 1e-9:.3f} s at image {wrong[0] + 2}" if wrong else ""
            times = f"{'stamps of' if by_header else 'times of logging, as some are 0 in'} its images' headers"
            raise DriverError(
                f"the {times} {back or f'are {step_ns / 1000:g} us apart'}: expected those of one clock that runs on; "
                'cut the log there, or choose log.time = "log", the times of logging, or "header"'
            )
    unset = np.count_nonzero(is_unset)
    return stamps_ns, f"used the times of logging: the headers of {unset} images are 0" if unset else ""


_WARNINGS = {
    "duplicate": "dropped {} frames with the same stamp as the frame before of the same camera",
    "broken_motion": "skipped {} messages of wheels or IMU that are not valid; the first: {fault}",
    "broken": "skipped {} messages of the cameras' topics that hold no valid image; the first: {fault}",
    "broken_records": "skipped {} corrupt chunks or records of the file; the first: {fault}",
}
WHOLE = (0.0, math.inf)  # span of all of a log [s]


class LogCameras(NamedTuple):
    """Which images of a log are those of the cameras, and how they are read."""

    lower: str | None = None  # topics, where their names do not identify the cameras
    upper: str | None = None
    bits: int = 16  # of the samples of images of 16 bits, see Frame
    time: TimeSource = "auto"  # which of its two times a message is stamped with, see `choose_stamps`


BY_NAME = LogCameras()
AnyCameras: TypeAlias = tuple[str | None, str | None] | LogCameras  # both topics, or more


class LogReader:
    """A FrameSource that streams a log once per call of frames().

    path: as for `open_log`. rig_topics: those that a rig states, which count where none are named and the log has them.
    span_s: the part of the log that is read, from and until so many seconds after the stamp of its first image.
    motion: topics of wheels and IMU; None: their samples are not read. Raises DriverError where the path is no such
    log, or the topics of the two cameras are ambiguous.

    topics: of the cameras. During and after frames() and messages(), `counts` has 'lower' and 'upper' (frames
    delivered), 'duplicate', 'broken' (messages without a valid image), 'broken_motion' and 'broken_records' (chunks or
    records of the file), and after their end `warnings` has one line per kind of fault.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        cameras: LogCameras = BY_NAME,
        rig_topics: tuple[str, str] = ("", ""),
        *,
        span_s: tuple[float, float] = WHOLE,
        motion: MotionTopics | None = None,
    ) -> None:
        self._closed, self._span_s, self._cameras = False, span_s, cameras
        self._log = open_log(path)
        self._motion, self._motion_warnings = set[str](), list[str]()
        self.counts, self.warnings = Counter[str](), list[str]()
        try:
            name, topics = repr(str(self._log.path)), self._log.topics
            self.topics = choose_topics(name, topics, (cameras.lower, cameras.upper), rig_topics)
            if motion is not None:
                self._motion, self._motion_warnings = choose_motion_topics(name, topics, motion)
        except DriverError as error:
            cut = self._log.cut
            self.close()
            raise DriverError(f"{error}; {cut}" if cut else str(error)) from error

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of both cameras in the order of their stamps; seq counts each camera's from 0."""
        return (message for message in self.messages() if isinstance(message, Frame))

    def messages(self) -> Iterator[Frame | MotionSample]:
        """Yield frames, and samples of wheels and IMU, in the order of their stamps."""
        cameras = {topic: camera for camera, topic in self.topics.items()}
        rows, stamps_ns, is_image, warning = self._order
        self.counts, self.warnings, faults = Counter(), [*self._motion_warnings], dict[str, str]()
        # 1. The part that is read, from the first image to the last one: samples after it are of no use.
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
        last_ns, used = dict[Camera, int](), set[str]()
        for row, stamp_ns in zip(rows[inside].tolist(), stamps_ns[inside].tolist(), strict=True):
            message = self._log.message(row)
            if self._closed:
                return
            if message is None:  # it is one of the faults of the log
                continue
            camera = cameras.get(message.topic)
            try:
                if camera is None:
                    sample = parse_motion(message.kind, message.data)
                    used.update([message.topic] if stamp_ns >= first_ns else [])
                    yield replace(sample, stamp_ns=stamp_ns)
                    continue
                image = parse_image(message.kind, message.data)
                image = replace(image, stamp_ns=stamp_ns, camera=camera, bits=self._cameras.bits)
            except FrameDecodeError as error:
                counter = "broken" if camera else "broken_motion"
                self.counts[counter] += 1
                faults.setdefault(counter, str(error))
                continue
            # A copy, so that a frame that is held back does not keep its chunk in memory.
            image = replace(image, seq=self.counts[camera], data=memoryview(bytes(image.data)))
            if stamp_ns == last_ns.get(camera):
                self.counts["duplicate"] += 1
                continue
            last_ns[camera] = stamp_ns
            self.counts[camera] += 1
            yield image
        # 3. What was wrong.
        self.counts["broken_records"] = len(self._log.faults)
        faults["broken_records"] = "".join(self._log.faults[:1])
        self.warnings += filter(None, (self._log.cut, warning))
        for name, text in _WARNINGS.items():
            if self.counts[name]:
                self.warnings.append(text.format(self.counts[name], fault=faults.get(name, "")))
        self.warnings += [  # of a part, samples that are farther apart than it is long need not be in it
            f"no sample of {topic} is used: by its stamps it is not of the time of the images: is it of another clock?"
            for topic in sorted(self._motion - used)
            if self._log.counts()[topic] and self._span_s == WHOLE
        ]

    @cached_property
    def _order(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_], str]:
        """The messages of the cameras, the wheels and the IMU, in the order of their stamps.

        Rows of the log (N,), stamps [ns] (N,), whether each is an image (N,), and a warning about the stamps.
        """
        log = self._log
        rows = log.rows({*self.topics.values(), *self._motion})
        entries, names = log.entries[rows], [*log.topics]
        of_camera = {camera: log.topic[rows] == names.index(topic) for camera, topic in self.topics.items()}
        try:
            stamps_ns, warning = choose_stamps(entries["header_ns"], entries["time_ns"], of_camera, self._cameras.time)
        except DriverError as error:
            raise DriverError(f"{str(log.path)!r}: {error}") from None
        # Of one stamp samples come first, then the lower camera, then the upper one.
        rank = of_camera["lower"] + 2 * of_camera["upper"]
        order = np.lexsort((rank, stamps_ns))
        return rows[order], stamps_ns[order], rank[order] > 0, warning

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
        """Return name -> bytes of the attachments, such as a rig."""
        return self._log.attachments()
