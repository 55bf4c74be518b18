"""Sources of wheel and gyro samples of a live run: the motor controller, a serial IMU, the bus."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from functools import partial

from drivers.imu.witmotion import WitMotionGyro
from omnid.controller.link import ControllerLink
from omnid.core.odometry.motion_settings import MotionSensorSettings
from omnid.runs.session import Session
from omnid.stages.motion_inbox import MotionInbox
from omnid.transport.sensor_receiver import SensorReceiver
from omnid.transport.topics import IMU, WHEEL_ODOM


class SensorSources:
    """One source for the wheels, one for the gyro: the nearest device that the settings name."""

    def __init__(self, settings: MotionSensorSettings, inbox: MotionInbox, session: Session,
                 controller: ControllerLink | None, report: Callable[[int, str], None]) -> None:
        """Open the IMU; DriverError where its port cannot be opened."""
        self._inbox = inbox
        topics = set()
        if settings.wheels == "auto":
            if controller is not None:
                controller.take_wheels = inbox.add
            else:
                topics.add(WHEEL_ODOM)
        self.gyro: WitMotionGyro | None = None
        if settings.imu == "auto":
            if settings.imu_port:
                self.gyro = WitMotionGyro(settings.imu_port, settings.imu_baud, partial(report, logging.WARNING))
                session.outputs.callback(self.gyro.close)
            else:
                topics.add(IMU)
        self.receiver = SensorReceiver(inbox.add, session.offset_ns, frozenset(topics),
                                       partial(report, logging.WARNING))

    def read_gyro(self) -> Iterator[None]:
        """Pass the samples of the serial IMU on until it is closed; yields once for each."""
        assert self.gyro is not None
        for sample in self.gyro.samples():
            self._inbox.add(sample)
            yield
