"""Registry of the simulated controllers, by the names that `motor.protocol` has for the protocols."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.roboteq import MIXED, POWER
from drivers.motors.simulated.simulated_arduino import SimulatedArduino
from drivers.motors.simulated.simulated_line import SimulatedLine
from drivers.motors.simulated.simulated_motor import SimulatedController
from drivers.motors.simulated.simulated_odrive import SimulatedODrive
from drivers.motors.simulated.simulated_roboteq import SimulatedRoboteq
from drivers.motors.simulated.simulated_vesc import SimulatedVesc
from drivers.motors.simulated.simulated_waveshare import SimulatedWaveshare

SIMULATED_CONTROLLERS: Mapping[str, Callable[[DifferentialDrive], SimulatedController]] = {
    "line": SimulatedLine,
    "roboteq": SimulatedRoboteq,
    "roboteq_power": partial(SimulatedRoboteq, mode=POWER),
    "roboteq_mixed": partial(SimulatedRoboteq, mode=MIXED),
    "odrive_ascii": SimulatedODrive,
    "vesc": SimulatedVesc,
    "waveshare_json": SimulatedWaveshare,
    "ros_arduino_bridge": SimulatedArduino,
}
