"""Sources of wheel and gyro samples of a live run: the motor controller, the bus, or a log."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import partial
from typing import Protocol

from drivers.logs.ros_messages import JointWheels
from drivers.logs.topics import MotionTopics
from drivers.motion import MotionSample
from omnid.config import Config
from omnid.controller.link import DriveLink
from omnid.engine.logging_setup import Report
from omnid.engine.robot_clock import RobotClock
from omnid.errors import OmnidError
from omnid.stages.motion_inbox import MotionInbox
from omnid.transport.commands import SensorReceiver
from omnid.transport.topics import IMU, JOINT_STATES, WHEEL_ODOM


def motion_topics(config: Config) -> MotionTopics:
    """Return the topics of a log to read. Raise OmnidError where only one of the two wheel joints is named."""
    settings = config.motion
    return MotionTopics(
        _topic(settings.wheels),
        _topic(settings.imu),
        joint_wheels(config),
    )


def _topic(named: str) -> str | None:
    """Return the topic of a log that a setting names; None: the only one, "": none."""
    return {"auto": None, "off": ""}.get(named, named)


def joint_wheels(config: Config) -> JointWheels | None:
    """Return the wheels as joints, None where they are an Odometry. Raise OmnidError where only one is named."""
    joints = config.motion.wheel_joints
    if not joints:
        return None
    if len(joints) != 2 or len(set(joints)) != 2:
        raise OmnidError(f"motion.wheel_joints = {list(joints)}: expected the names of two joints, or none")
    drive = config.motor.drive.geometry()
    return JointWheels(*joints, drive.wheel_radius_m, drive.track_m)


class MotionSource(Protocol):
    """A source of samples, read by a thread of its own."""

    def samples(self) -> Iterator[MotionSample]:
        """Yield the samples until closed."""

    def close(self) -> None:
        """End samples(); from any thread."""


class SensorSources:
    """One source for the wheels and one for the gyro.

    Wheels: the motor controller, else a topic of the bus. Gyro: a topic of the bus. Where the images come from a log
    or a simulation, so do both, because samples of another motion would not fit these images.
    """

    def __init__(
        self,
        config: Config,
        inbox: MotionInbox,
        clock: RobotClock,
        controller: DriveLink | None,
        report: Report,
        *,
        with_images: bool = False,
    ) -> None:
        """clock: that of the stamps of images. with_images: the samples come with the images."""
        settings, joints = config.motion, joint_wheels(config)
        topics = set()
        if settings.wheels != "off" and not with_images:
            if controller is not None:
                controller.take_wheels = inbox.add
            else:
                topics.add(JOINT_STATES if joints else WHEEL_ODOM)
        if settings.imu != "off" and not with_images:
            topics.add(IMU)
        self.receiver = SensorReceiver(
            inbox.add, clock.stamp_ns, frozenset(topics), partial(report, logging.WARNING), joints
        )
