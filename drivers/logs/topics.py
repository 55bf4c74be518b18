"""Choice of the topics of a log that are the lower and the upper camera, the wheels and the IMU."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from drivers.errors import DriverError
from drivers.frame import CAMERAS, Camera
from drivers.logs.log import listed
from drivers.logs.ros_messages import COMPRESSED_IMAGE, IMAGE, IMAGE_TYPES, IMU, JOINT_STATE, ODOMETRY, JointWheels

_WORDS: dict[str, Camera] = {
    "lower": "lower",
    "bottom": "lower",
    "down": "lower",
    "upper": "upper",
    "top": "upper",
    "up": "upper",
}
_COMPRESSED = "/compressed"  # ends the names of compressed images (image_transport)

Wanted = Mapping[Camera, str | None]


def choose_topics(log: str, topics: Mapping[str, str], wanted: Wanted) -> dict[Camera, str]:
    """Return the topics of the two cameras.

    log: its name for error messages. topics: name -> type. wanted: requested topics, which must exist; a camera
    without one is identified by a word of its topic's name. Raises DriverError, which lists the candidates, where the
    choice is ambiguous.
    """
    images = [name for name, kind in topics.items() if kind in IMAGE_TYPES and not name.endswith("/compressedDepth")]
    if not topics:
        raise DriverError(f"no messages can be read in {log}: `omnid log info` says whether it was cut")
    if not images:
        raise DriverError(
            f"no image topics in {log}: found {listed(topics)}; record {IMAGE} or {COMPRESSED_IMAGE} of both cameras"
        )
    given = {camera: _given(log, topics, wanted[camera]) for camera in CAMERAS}
    free = [name for name in images if name not in given.values()]
    lower, upper = (given[camera] or _guessed(log, free, camera) for camera in CAMERAS)
    if lower is None and upper is None and len(_images(images)) > 1:
        raise DriverError(f"cannot tell the cameras in {log} apart: found {listed(images)}; give --lower and --upper")
    if lower is None or upper is None:
        missing = "lower" if lower is None else "upper"
        raise DriverError(f"no {missing} camera in {log}: found only {listed(images)}; give --{missing} TOPIC")
    if lower == upper:
        raise DriverError(f"topic {lower!r} of {log} is named for both cameras: expected two topics")
    return {"lower": lower, "upper": upper}


class MotionTopics(NamedTuple):
    """Topics of wheels and of an IMU; None: chosen by name and type; empty: none."""

    wheels: str | None = None
    imu: str | None = None
    joints: JointWheels | None = None  # the wheels are these joints of a JointState; None: they are an Odometry


class MotionChoice(NamedTuple):
    """The topics of wheels and IMU that are read, and why others that might be meant are not."""

    names: frozenset[str]
    warning: str = ""


def choose_motion_topics(log: str, topics: Mapping[str, str], wanted: MotionTopics) -> MotionChoice:
    """Return the topics of wheels and IMU; where several might be meant, none, and a warning.

    A topic of odometry is that of wheels if its name contains "wheel", because others are results; a topic of joints
    may have any name. Raises DriverError for a requested topic that does not exist or is of another type.
    """
    chosen, warnings = [], []
    # omnid records the wheels of joints as an Odometry.
    of_joints = wanted.joints and (wanted.wheels or JOINT_STATE in topics.values())
    wheels = JOINT_STATE if of_joints else ODOMETRY
    for kind, name, setting in ((wheels, wanted.wheels, "motion.wheels"), (IMU, wanted.imu, "motion.imu")):
        if name:
            if topics.get(name) != kind:
                found = f"holds {topics[name]}" if topics.get(name) else "is not"
                raise DriverError(f"topic {name!r} {found} in {log}; {setting} must be one of {kind}: {listed(topics)}")
            chosen.append(name)
        elif name is None:
            found_names = [
                topic
                for topic, found in topics.items()
                if found == kind and (kind != ODOMETRY or "wheel" in topic.lower())
            ]
            if len(found_names) > 1:
                warnings.append(
                    f"{log} has several topics of {kind}: {listed(found_names)}; none is used: set {setting}"
                )
            else:
                chosen += found_names
    return MotionChoice(frozenset(chosen), "; ".join(warnings))


def _given(log: str, topics: Mapping[str, str], name: str | None) -> str | None:
    """Return the topic of a requested camera; image_transport publishes it raw, compressed, or both."""
    if name is None:
        return None
    transports = name, f"{name}{_COMPRESSED}", name.removesuffix(_COMPRESSED)
    name = next((topic for topic in transports if topic in topics), name)
    if name not in topics:
        raise DriverError(f"no topic {name!r} in {log}: found {listed(topics)}; give one of these")
    if topics[name] not in IMAGE_TYPES:
        raise DriverError(f"topic {name!r} in {log} holds {topics[name] or 'no CDR'}; give one of: {listed(topics)}")
    return name


def _guessed(log: str, names: Sequence[str], camera: Camera) -> str | None:
    """Return the topic named after the camera, preferably the compressed one, None without one.

    Raises DriverError where several cameras have such a name.
    """
    # The first word that names a camera counts: /upper/down_sampled is the upper camera.
    words = {name: re.split(r"[^a-z0-9]+", name.lower()) for name in names}
    mine = [name for name in names if next((_WORDS[word] for word in words[name] if word in _WORDS), None) == camera]
    if len(_images(mine)) > 1:
        raise DriverError(f"several {camera} cameras in {log}: found {listed(mine)}; give one of them by --{camera}")
    return max(mine, key=lambda name: name.endswith(_COMPRESSED), default=None)


def _images(names: Iterable[str]) -> set[str]:
    return {name.removesuffix(_COMPRESSED) for name in names}
