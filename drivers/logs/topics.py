"""Choice of the topics of a log that are the lower and the upper camera, the wheels and the IMU."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
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
    if not topics:
        raise DriverError(f"no messages can be read in {log}: `omnid log info` says whether it was cut")
    if not images:
        raise DriverError(
            f"no image topics in {log}: found {listed(topics)}; record {IMAGE} or {COMPRESSED_IMAGE} of both cameras"
        )
    # 1. Requested topics; image_transport publishes an image raw, compressed, or both.
    found: dict[Camera, str] = {}
    for camera, name in wanted.items():
        if name is None:
            continue
        transports = name, f"{name}{_COMPRESSED}", name.removesuffix(_COMPRESSED)
        topic = next((topic for topic in transports if topic in topics), name)
        if topic not in topics:
            raise DriverError(f"no topic {topic!r} in {log}: found {listed(topics)}; give one of these")
        if topics[topic] not in IMAGE_TYPES:
            holds = topics[topic] or "no CDR"
            raise DriverError(f"topic {topic!r} in {log} holds {holds}; give one of: {listed(topics)}")
        found[camera] = topic
    # 2. Topics named after a camera, by the first word that names one: /upper/down_sampled is the upper camera.
    free = [name for name in images if name not in found.values()]
    words = {name: [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word in _WORDS] for name in free}
    for camera in CAMERAS:
        mine = [name for name in free if words[name] and _WORDS[words[name][0]] == camera]
        if camera in found or not mine:
            continue
        if len(_images(mine)) > 1:
            raise DriverError(
                f"several {camera} cameras in {log}: found {listed(mine)}; give one of them by --{camera}"
            )
        found[camera] = max(mine, key=lambda name: name.endswith(_COMPRESSED))
    if not found and len(_images(images)) > 1:
        raise DriverError(f"cannot tell the cameras in {log} apart: found {listed(images)}; give --lower and --upper")
    for camera in CAMERAS:
        if camera not in found:
            raise DriverError(f"no {camera} camera in {log}: found only {listed(images)}; give --{camera} TOPIC")
    if found["lower"] == found["upper"]:
        raise DriverError(f"topic {found['lower']!r} of {log} is named for both cameras: expected two topics")
    return found


def _images(names: Iterable[str]) -> set[str]:
    return {name.removesuffix(_COMPRESSED) for name in names}


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
