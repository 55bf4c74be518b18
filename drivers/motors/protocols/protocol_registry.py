"""Protocols of motor controllers by their names in the configuration (motor.protocol).

Another package adds a protocol by an entry point, whose name is the protocol's:

    [project.entry-points."omnid.motor_protocols"]
    sabertooth = "my_package:Sabertooth"

The object is called with a DifferentialDrive and returns a MotorProtocol.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Final, TypeAlias

from drivers.errors import DriverError
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.line_protocol import LineProtocol
from drivers.motors.protocols.motor_protocol import MotorProtocol
from drivers.motors.protocols.odrive_ascii import ODriveAscii
from drivers.motors.protocols.roboteq import Roboteq
from drivers.motors.protocols.vesc import Vesc

GROUP: Final = "omnid.motor_protocols"
ProtocolFactory: TypeAlias = Callable[[DifferentialDrive], MotorProtocol]
PROTOCOLS: Final[Mapping[str, ProtocolFactory]] = {
    "line": LineProtocol,
    "roboteq": Roboteq,
    "odrive_ascii": ODriveAscii,
    "vesc": Vesc,
}


def motor_protocol(name: str) -> ProtocolFactory:
    """Return the protocol of this name, of omnid or of an installed package; raise DriverError where there is none."""
    if name in PROTOCOLS:
        return PROTOCOLS[name]
    installed = entry_points(group=GROUP)
    if name not in installed.names:
        known = ", ".join([*PROTOCOLS, *sorted(installed.names - PROTOCOLS.keys())])
        raise DriverError(
            f"motor.protocol {name!r} is not known: expected one of {known}; "
            f"other packages add protocols by the entry point group {GROUP!r}"
        )
    try:
        factory: ProtocolFactory = installed[name].load()
    except (ImportError, AttributeError) as error:
        raise DriverError(f"motor.protocol {name!r}: its package cannot be loaded: {error}") from error
    return factory
