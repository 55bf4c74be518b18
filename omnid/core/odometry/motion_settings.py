"""Settings of wheels and gyro."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from calib import se3


@dataclass(frozen=True, slots=True)
class MotionSensorSettings:
    """Wheels and gyro in addition to the cameras. Scales, bias and offsets of their clocks are estimated on the way."""

    wheels: Annotated[
        Literal["auto", "off"],
        "speeds of the wheels: those that the motor controller reports, of the bus (cmd/wheel_odom) or of the log",
    ] = "auto"
    imu: Annotated[Literal["auto", "off"], "gyro: that of the bus (cmd/imu) or of the log"] = "auto"
    wheel_topic: Annotated[
        str,
        "topic of a log with nav_msgs/msg/Odometry of the wheels; empty: the only one whose "
        "name contains 'wheel'. With left_joint: of JointState; empty: the only one",
    ] = ""
    left_joint: Annotated[
        str,
        "name of the left wheel in sensor_msgs/msg/JointState, of a log or cmd/joint_states, "
        "which then stands for the Odometry of the wheels; empty: none",
    ] = ""
    right_joint: Annotated[str, "name of the right one; radius and track are those of motor.drive"] = ""
    imu_topic: Annotated[str, "topic of a log with sensor_msgs/msg/Imu; empty: the only one"] = ""
    imu_roll_deg: Annotated[
        float,
        Meta(ge=-360, le=360),
        "orientation of the IMU on the base: roll about x, deg; not applied to messages in the frame base_link",
    ] = 0.0
    imu_pitch_deg: Annotated[float, Meta(ge=-360, le=360), "... then pitch about y, deg"] = 0.0
    imu_yaw_deg: Annotated[float, Meta(ge=-360, le=360), "... then yaw about z, deg"] = 0.0

    @property
    def R_base_imu(self) -> NDArray[np.float64]:
        """Rotation (3, 3) from the axes of the IMU to those of the base."""
        roll, pitch, yaw = np.radians([self.imu_roll_deg, self.imu_pitch_deg, self.imu_yaw_deg])
        turns = ([0, 0, yaw], [0, pitch, 0], [roll, 0, 0])
        return np.asarray(np.linalg.multi_dot([se3.rotation_exp(turn) for turn in turns]))
