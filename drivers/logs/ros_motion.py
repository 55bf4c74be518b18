"""Decodes Odometry and JointState of wheels, and Imu, from the bytes of ROS 2 (CDR) or ROS 1."""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

from drivers.errors import FrameDecodeError
from drivers.logs.joint_wheels import JOINT_STATE, JointWheels
from drivers.logs.ros_members import MemberReader, cdr_members, header
from drivers.motion import GyroSample, MotionSample, WheelSample

ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"
MOTION_TYPES = (ODOMETRY, IMU, JOINT_STATE)
MOST_JOINTS = 256
BASE_FRAME = "base_link"  # Frame of messages whose axes are those of the base (REP 105), as omnid records them.
NOT_MEASURED = -1.0  # first number of the covariance of what an IMU does not measure (sensor_msgs/msg/Imu)

_POSE_NUMBERS = 7 + 36  # position, orientation, covariance
_ORIENTATION_NUMBERS = 4 + 9


class MotionReading(NamedTuple):
    """Rates in one message: forward velocity and yaw rate of wheels, or three angular velocities of an IMU."""

    stamp_ns: int  # stamp of the header, 0 if unset
    rates: tuple[float, ...]  # m/s and rad/s; empty: it is of other joints
    frame: str = ""  # frame of the header

    def sample(self, log_time_ns: int) -> MotionSample:
        """Return the sample; log_time_ns: its stamp where the header has none."""
        stamp_ns = self.stamp_ns or log_time_ns
        if len(self.rates) == 2:
            return WheelSample(stamp_ns, *self.rates)
        x, y, z = self.rates
        return GyroSample(stamp_ns, x, y, z, of_base=self.frame == BASE_FRAME)


def parse_motion(
    schema_name: str, message: memoryview, *, aligned: bool = True, joints: JointWheels | None = None
) -> MotionReading:
    """Return the rates in a message of type ODOMETRY, IMU or JOINT_STATE; raise FrameDecodeError where it is invalid.

    aligned: True for CDR (ROS 2), False for the serialisation of ROS 1. joints: the wheels in a JOINT_STATE.
    """
    try:
        members = cdr_members(message) if aligned else MemberReader(message, "<", aligned=False)
        stamp_ns, frame = header(members)
        if schema_name == ODOMETRY:
            members.string()  # child_frame_id: the twist is that of the base
            _skip(members, _POSE_NUMBERS)
            twist = [members.number("d") for _ in range(6)]
            rates: tuple[float, ...] = (twist[0], twist[5])
        elif schema_name == JOINT_STATE:
            return MotionReading(stamp_ns, _joint_rates(members, joints))
        else:
            _skip(members, _ORIENTATION_NUMBERS)
            rates = tuple(members.number("d") for _ in range(3))
            if members.number("d") == NOT_MEASURED:
                raise FrameDecodeError(f"a {IMU} has no angular velocity: its covariance begins with -1")
    except struct.error as error:
        raise FrameDecodeError(f"a {schema_name} of {len(message)} bytes is truncated") from error
    must_be_known = rates[:1] if schema_name == ODOMETRY else rates  # wheels may not report their turn
    if not all(map(math.isfinite, must_be_known)) or any(map(math.isinf, rates)):
        raise FrameDecodeError(f"a {schema_name} has rates that are not finite")
    return MotionReading(stamp_ns, rates, frame)


def _joint_rates(members: MemberReader, joints: JointWheels | None) -> tuple[float, ...]:
    """Return the rates of the base; empty where the wheels are not among the joints."""
    names = [members.string() for _ in range(_count(members))]
    _skip(members, _count(members))  # positions
    velocities = [members.number("d") for _ in range(_count(members))]
    if joints is None:
        return ()
    known = dict.fromkeys(names, math.nan) | dict(zip(names, velocities, strict=False))
    return joints.rates(known) or ()


def _count(members: MemberReader) -> int:
    """Return the length of a sequence."""
    count = int(members.number("I"))
    if count > MOST_JOINTS:
        raise FrameDecodeError(f"a {JOINT_STATE} has {count} joints, more than {MOST_JOINTS}")
    return count


def _skip(members: MemberReader, numbers: int) -> None:
    for _ in range(numbers):
        members.number("d")
