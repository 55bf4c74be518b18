"""Which topics of a log are the cameras, the wheels and the IMU, and by which of its two times a message is stamped.

A camera driver stamps the header when the image is taken; the recorder logs the message when it arrives. The headers
are better, and are used unless some are not set. Times that run back are refused: `log.time` says which are used.
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
    for of_it in of_camera.values():
        of_it = of_it & (header_ns >= 0)
        steps_ns, is_repeated = np.diff(stamps_ns[of_it]), np.diff(log_ns[of_it]) == 0
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
