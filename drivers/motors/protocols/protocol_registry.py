"""Protocols of motor controllers by their names in the configuration (motor.protocol)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.line_protocol import LineProtocol
from drivers.motors.protocols.motor_protocol import MotorProtocol
from drivers.motors.protocols.odrive_ascii import ODriveAscii
from drivers.motors.protocols.roboteq import MIXED, POWER, Roboteq
from drivers.motors.protocols.ros_arduino_bridge import RosArduinoBridge
from drivers.motors.protocols.vesc import Vesc
from drivers.motors.protocols.waveshare_json import WaveshareJson

PROTOCOLS: Mapping[str, Callable[[DifferentialDrive], MotorProtocol]] = {
    "line": LineProtocol,
    "roboteq": Roboteq,
    "roboteq_power": partial(Roboteq, mode=POWER),
    "roboteq_mixed": partial(Roboteq, mode=MIXED),
    "odrive_ascii": ODriveAscii,
    "vesc": Vesc,
    "waveshare_json": WaveshareJson,
    "ros_arduino_bridge": RosArduinoBridge,
}
