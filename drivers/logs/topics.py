"""Choice of the topics of a log that are the lower and the upper camera, the wheels and the IMU."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

from drivers.errors import DriverError
from drivers.frame import CAMERAS, Camera
from drivers.logs.log import listed
from drivers.logs.ros_messages import COMPRESSED_IMAGE, IMAGE, IMAGE_TYPES, IMU, JOINT_STATE, ODOMETRY, JointWheels

_WORDS: dict[str, Camera] = {
    **dict.fromkeys(("lower", "bottom", "down"), CAMERAS[0]),
    **dict.fromkeys(("upper", "top", "up"), CAMERAS[1]),
}
_COMPRESSED = "/compressed"  # ends the names of compressed images (image_transport)


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
    chosen, warnings = list[str](), list[str]()
    # omnid records the wheels of joints as an Odometry.
    of_joints = wanted.joints and (wanted.wheels or JOINT_STATE in topics.values())
    wheels = JOINT_STATE if of_joints else ODOMETRY
    for kind, name, setting in ((wheels, wanted.wheels, "motion.wheels"), (IMU, wanted.imu, "motion.imu")):
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
            chosen += names
    return MotionChoice(frozenset(chosen), "; ".join(warnings))
