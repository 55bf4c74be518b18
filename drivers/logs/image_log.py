"""A log of images in any format: the messages that a reader of frames and of motion needs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple, Protocol

from drivers.logs.joint_wheels import JointWheels
from drivers.logs.ros_image import IMAGE_TYPES, RosImage, parse_image
from drivers.logs.ros_motion import MOTION_TYPES, MotionReading, parse_motion


class LoggedImage(NamedTuple):
    """An image message that is not yet decoded."""

    topic: str
    log_time_ns: int
    read: Callable[[], RosImage]  # raises FrameDecodeError or RecordError where there is no valid image


class LoggedMotion(NamedTuple):
    """A message of wheels or of an IMU that is not yet decoded."""

    topic: str
    log_time_ns: int
    read: Callable[[JointWheels | None], MotionReading]  # raises FrameDecodeError or RecordError: no valid message


def logged_message(
    topic: str, kind: str, log_time_ns: int, data: Callable[[], memoryview], *, aligned: bool = True
) -> LoggedImage | LoggedMotion | None:
    """Return a message of a type of images or of motion, None of any other type; it is decoded when it is read.

    data: returns its bytes, raises RecordError where they cannot be read. aligned: True for CDR (ROS 2), False for the
    serialisation of ROS 1.
    """
    if kind in IMAGE_TYPES:
        return LoggedImage(topic, log_time_ns, lambda: parse_image(kind, data(), aligned=aligned))
    if kind in MOTION_TYPES:
        return LoggedMotion(
            topic, log_time_ns, lambda joints: parse_motion(kind, data(), aligned=aligned, joints=joints)
        )
    return None


class LogDamage(NamedTuple):
    """Faults that were found while a log was read."""

    broken: int = 0  # chunks and records that were skipped
    cut: str = ""  # one line that says where a log ends too early; empty for a complete log


class ImageLog(Protocol):
    """The image messages of a log, streamed in its order; it may be damaged or malicious."""

    name: str  # for error messages

    def topics(self) -> Mapping[str, str]:
        """Return name -> ROS type of all topics, such as sensor_msgs/msg/Image; '' where it cannot be decoded."""

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of messages of each topic; None where the log does not state it."""

    def messages(self) -> Iterator[LoggedImage | LoggedMotion]:
        """Yield the images of all topics, and the messages of wheels and IMUs; ends early after close."""

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments, such as a rig; at most 32 of up to 16 MiB each, 64 MiB in all."""

    def damage(self) -> LogDamage:
        """Return the faults found by the last call of messages(), once that has ended."""

    def close(self) -> None:
        """Close the files; may be called twice."""


def images_of(log: ImageLog) -> Iterator[LoggedImage]:
    """Yield the images among the messages of a log."""
    return (message for message in log.messages() if isinstance(message, LoggedImage))
