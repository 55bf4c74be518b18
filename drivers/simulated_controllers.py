"""The twins of the controllers by the names of their protocols."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from drivers.differential_drive import DifferentialDrive
from drivers.roboteq import MIXED, POWER
from drivers.simulated_arduino import SimulatedArduino
from drivers.simulated_line import SimulatedLine
from drivers.simulated_motor import SimulatedController
from drivers.simulated_odrive import SimulatedODrive
from drivers.simulated_roboteq import SimulatedRoboteq
from drivers.simulated_vesc import SimulatedVesc
from drivers.simulated_waveshare import SimulatedWaveshare

TWINS: Mapping[str, Callable[[DifferentialDrive], SimulatedController]] = {
    "line": SimulatedLine,
    "roboteq": SimulatedRoboteq,
    "roboteq_power": partial(SimulatedRoboteq, mode=POWER),
    "roboteq_mixed": partial(SimulatedRoboteq, mode=MIXED),
    "odrive_ascii": SimulatedODrive,
    "vesc": SimulatedVesc,
    "waveshare_json": SimulatedWaveshare,
    "ros_arduino_bridge": SimulatedArduino,
}
