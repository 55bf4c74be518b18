"""Settings of wheels and gyro."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from calib import se3


@dataclass(frozen=True, slots=True)
class MotionSensorSettings:
    """Wheels and gyro in addition to the cameras. Scales, bias and offsets of their clocks are estimated on the way."""

    wheels: Annotated[
        str,
        "speeds of the wheels; auto: those that the motor controller reports, of the bus (cmd/wheel_odom), or of the "
        "only topic of a log with nav_msgs/msg/Odometry whose name contains 'wheel'; off; or that topic of the log",
    ] = "auto"
    imu: Annotated[
        str,
        "gyro; auto: that of the bus (cmd/imu), or of the only topic of a log with sensor_msgs/msg/Imu; off; or that "
        "topic of the log",
    ] = "auto"
    imu_rpy_deg: Annotated[
        tuple[float, float, float],
        "orientation of the IMU on the base: roll about x, then pitch about y, then yaw about z, deg; not applied to "
        "messages in the frame base_link",
    ] = (0.0, 0.0, 0.0)

    @property
    def R_base_imu(self) -> NDArray[np.float64]:
        """Rotation (3, 3) from the axes of the IMU to those of the base."""
        roll, pitch, yaw = np.radians(self.imu_rpy_deg)
        turns = ([0, 0, yaw], [0, pitch, 0], [roll, 0, 0])
        return np.asarray(np.linalg.multi_dot([se3.rotation_exp(turn) for turn in turns]))
