"""Which topics of a log are the cameras, the wheels and the IMU, and by which of its two times a message is stamped.

A camera driver stamps the header when the image is taken; the recorder logs the message when it arrives. The header is
the better one, and is used unless it is not set. Headers that run back are refused: `log.time` says
which time is used. In a file the images of a camera are in the
order of their headers, but for late ones, which fill a hole between others. Where a clock was set back, images lie
beside others instead, or far behind.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError
from drivers.frame import CAMERAS, Camera
from drivers.logs.log import listed
from drivers.logs.ros_messages import COMPRESSED_IMAGE, IMAGE, IMAGE_TYPES, IMU, ODOMETRY

Times: TypeAlias = NDArray[np.int64]  # (N,) [ns]
TimeSource: TypeAlias = Literal["auto", "header", "log"]

_WORDS: dict[str, Camera] = {
    **dict.fromkeys(("lower", "bottom", "down"), CAMERAS[0]),
    **dict.fromkeys(("upper", "top", "up"), CAMERAS[1]),
}
_COMPRESSED = "/compressed"  # ends the names of compressed images (image_transport)
_SHORTEST_STEP_NS: Final = 1_000_000  # No camera takes 1,000 images a second: these are stamps in microseconds.
_STEP_NS: Final = 500_000_000  # An image is logged by less behind a later one, unless a clock is set.
_FEW: Final = 0.1  # Up to this share of headers may be unset.


def choose_topics(log: str, topics: Mapping[str, str], wanted: Mapping[Camera, str | None]) -> dict[Camera, str]:
    """Return the topics of the two cameras.

    log: its name for error messages. topics: name -> type. wanted: requested topics, which must exist; a camera
    without one is identified by a word of its topic's name. Raises DriverError, which lists the candidates, where the
    choice is ambiguous.
    """
    images = [name for name, kind in topics.items() if kind in IMAGE_TYPES and not name.endswith("/compressedDepth")]
    if not images:
        raise DriverError(
            f"no image topics in {log}: found {listed(topics, 'no messages')}; record {IMAGE} or {COMPRESSED_IMAGE} of "
            "both cameras; `omnid log info` says whether the log was cut"
        )
    found: dict[Camera, str] = {}
    for camera, name in wanted.items():
        if name is not None:
            # image_transport publishes an image raw, compressed, or both.
            transports = name, f"{name}{_COMPRESSED}", name.removesuffix(_COMPRESSED)
            mine = [topic for topic in transports if topic in images][:1]
        else:
            mine = [topic for topic in images if _camera_of(topic) == camera]
        if len({topic.removesuffix(_COMPRESSED) for topic in mine}) != 1:
            named = f"{'several' if mine else 'no'} topics named after the {camera} camera"
            problem = named if name is None else f"no topic {name!r} of images"
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
            found = f"holds {topics[name]}" if topics.get(name) else "is not"
            raise DriverError(f"topic {name!r} {found} in {log}; {setting} must be one of {kind}: {listed(topics)}")
        names = [name] if name else []
        if name is None:
            of_kind = (topic for topic, found in topics.items() if found == kind)
            names = [topic for topic in of_kind if kind != ODOMETRY or "wheel" in topic.lower()]
        if len(names) > 1:
            warnings.append(f"{log} has several topics of {kind}: {listed(names)}; none is used: set {setting}")
        else:
            chosen.update(names)
    return chosen, warnings


class StampRule(NamedTuple):
    """By which time the messages of a log are stamped."""

    by_header: bool
    delay_ns: int  # usual stamp of the lower camera minus the time of logging, for messages whose header is not set
    warnings: list[str]

    def stamps_ns(self, header_ns: Times, log_ns: Times) -> Times:
        """Return the stamps (N,) of messages."""
        return np.where(self.by_header & (header_ns > 0), header_ns, log_ns + self.delay_ns)


def stamp_rule(images: Mapping[Camera, tuple[Times, Times]], source: TimeSource = "auto") -> StampRule:
    """Return how the messages of a log are stamped, by the images of both cameras.

    images: stamps of the headers, 0 where unset, and times of logging, in the order of the file. Raise DriverError, by
    "auto", where the times run back, or are too close to each other.
    """
    # 1. Headers that are not set.
    both, is_auto, warnings = [images[camera] for camera in CAMERAS], source == "auto", list[str]()
    unset = [int(np.count_nonzero((header_ns == 0) & (log_ns != 0))) for header_ns, log_ns in both]
    is_unset = any(count > max(1, _FEW * len(header_ns)) for count, (header_ns, _) in zip(unset, both, strict=True))
    by_header = source == "header" or (is_auto and not is_unset)
    used = sum(unset) if by_header else is_auto * sum(len(log_ns) for _, log_ns in both)
    if used:
        warnings.append(f"used the times of logging for {used} images: the stamps of their headers are 0")
    # 2. Times that are wrong.
    faults = [_fault(header_ns if by_header else log_ns, log_ns) for header_ns, log_ns in both if is_auto]
    if fault := next(filter(None, faults), ""):
        times = "stamps of its images' headers" if by_header else "headers of its images are 0, the times of logging"
        raise DriverError(
            f"the {times} {fault}: expected those of one clock that runs on; cut the log there, or choose "
            'log.time = "log", the times of logging, or "header"'
        )
    # 3. Where a header is unset, the time of logging with the usual delay counts.
    header_ns, log_ns = both[0]
    is_set = by_header & (header_ns > 0)
    delay_ns = round(float(np.median((header_ns - log_ns)[is_set]))) if is_set.any() else 0
    return StampRule(by_header, delay_ns, warnings)


def _fault(times: Times, log_ns: Times) -> str:
    """Return why times cannot be those at which a camera took its images; empty where they can.

    The images are in the order of the file; a message that is there twice, logged at one time, counts once.
    """
    is_repeated = (np.diff(times, prepend=-1) == 0) & (np.diff(log_ns, prepend=-1) == 0)
    times = times[~is_repeated & (times > 0)]
    order, place, counts = np.unique(times, return_inverse=True, return_counts=True)
    if len(order) < 2:
        return ""
    # An image behind the latest one must fill a hole: closer than half a period to others there is none.
    behind_ns = np.maximum.accumulate(times) - times
    steps_ns = np.diff(order)
    step_ns = np.median(steps_ns)
    if step_ns < _SHORTEST_STEP_NS:
        return f"are {step_ns / 1000:g} us apart"
    gaps_ns = np.concatenate([[np.inf], steps_ns, [np.inf]])
    is_crowded = (np.minimum(gaps_ns[:-1], gaps_ns[1:]) <= step_ns / 2) | (counts > 1)
    is_late = np.append(False, times[1:] < np.maximum.accumulate(times)[:-1])
    wrong = np.flatnonzero((is_late & is_crowded[place]) | (behind_ns > _STEP_NS)).tolist()
    return f"run back by {behind_ns[wrong[0]] * 1e-9:.3f} s at image {wrong[0] + 1}" if wrong else ""
