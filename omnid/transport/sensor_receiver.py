"""Samples of wheels and gyro from the network, validated: `cmd/wheel_odom` (nav_msgs/msg/Odometry), `cmd/imu` (Imu),
`cmd/joint_states` (JointState).

They are below `cmd`, because they move the pose while the cameras show nothing: only programs that may command the
robot may write them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Final

from drivers.logs.ros_messages import JointWheels
from drivers.motion import MotionSample
from omnid.errors import OmnidError
from omnid.transport.motion_codec import sample_from_cdr
from omnid.transport.topics import SENSOR_TOPICS

LONGEST_PAYLOAD: Final = 8192  # bytes


class SensorReceiver:
    """Passes valid samples on and counts the others; called from threads of the bus, never raises."""

    def __init__(
        self,
        target: Callable[[MotionSample], None],
        offset_ns: int,
        topics: frozenset[str],
        report: Callable[[str], None],
        joints: JointWheels | None = None,
    ) -> None:
        """target: may be called from any thread. offset_ns: from the stamps of images to Unix time.

        topics: those that are used. report: takes a line for the log, once for each topic. joints: the wheels.
        """
        self._joints = joints
        self._target, self._offset_ns, self._topics, self._report = target, offset_ns, topics, report
        self.refused: Counter[str] = Counter()  # by topic

    def receive(self, key: str, payload: bytes) -> None:
        """Handle one message."""
        try:
            if key not in self._topics:
                raise OmnidError("it is not used: see motion.wheels, motion.wheel_joints and motion.imu")
            if len(payload) > LONGEST_PAYLOAD:
                raise OmnidError(f"it has {len(payload)} bytes, more than {LONGEST_PAYLOAD}")
            sample = sample_from_cdr(payload, SENSOR_TOPICS[key], self._offset_ns, self._joints)
        except OmnidError as error:
            self.refused[key] += 1
            if self.refused[key] == 1:
                self._report(f"a message on {key} is refused: {error}; more of them are counted in the status")
            return
        if sample is not None:
            self._target(sample)
