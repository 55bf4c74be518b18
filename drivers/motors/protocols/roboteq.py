"""Roboteq dual-channel controllers: commands <-> ASCII lines, no I/O.

Source: Roboteq Controllers User Manual, chapters "Serial (RS232/USB) operation" and "Commands Reference".

    "!S ch rpm"    closed-loop speed of a channel, -65535 .. 65535
    "^RWD ms"      serial watchdog, read back by "~RWD"; 0 is off. Only "!" commands feed it, and the next one drives
                   again, which is why the driver sends a stop first
    "^ECHOF 1"     no echo; echoed lines are skipped until it is in force
    "~MXMD"        mixing mode; 0 is off, as the speeds of the channels need it
    "?S"           speeds in rpm; "?V 2" battery in 0.1 V; "?FF" fault flags

Each line ends in CR; "+" confirms, "-" rejects, the reply to a query is "NAME=value:value". All lines of a command
are written at once: on a USB adapter each round trip may take 16 ms (the default latency timer of FTDI's chips).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.protocols.motor_protocol import DifferentialDrive, TextFramer, Transaction, require_watchdog

MAX_RPM = 65535

_REPLY = re.compile(rb"([A-Z]{1,6})=(-?[0-9]{1,10}(?::-?[0-9]{1,10}){0,9})")


class Roboteq:
    """One dual-channel controller in closed-loop speed mode."""

    baud = 115_200
    framer = TextFramer

    def __init__(self, drive: DifferentialDrive) -> None:
        self._drive, self._rpm_per_mps = drive, drive.rpm_per_mps

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Set the serial watchdog, read it back and return the time in force [ms].

        Raises DriverError where another time is in force, or the controller mixes its channels.
        """
        lines = [b"^ECHOF 1", b"^RWD %d" % watchdog_ms, b"~RWD", b"~MXMD"]
        values = yield from self._query(lines, {b"RWD", b"MXMD"})
        if values[b"MXMD"][0]:
            raise DriverError(f"its mixing mode is {values[b'MXMD'][0]}; switch mixing off (^MXMD 0)")
        require_watchdog(watchdog_ms, values[b"RWD"][0])
        return values[b"RWD"][0]

    def drive(self, command: VelocityCommand) -> Transaction[MotorStatus]:
        """Send the commands of both channels and the queries at once, and return the status."""
        speeds_mps = self._drive.channels(command, MAX_RPM / self._rpm_per_mps)
        lines = [b"!S %d %d" % (channel, round(mps * self._rpm_per_mps)) for channel, mps in enumerate(speeds_mps, 1)]
        values = yield from self._query([*lines, b"?S", b"?V 2", b"?FF"], {b"S", b"V", b"FF"})
        if len(values[b"S"]) < 2:
            raise DriverError("it has one channel; a base needs two")
        first_rpm, second_rpm = values[b"S"][:2]
        velocity_mps, yaw_rate_radps = self._drive.motion(first_rpm / self._rpm_per_mps, second_rpm / self._rpm_per_mps)
        battery_v = values[b"V"][-1] / 10
        return MotorStatus(velocity_mps, float("nan"), yaw_rate_radps, False, values[b"FF"][0], battery_v)

    def _query(self, lines: Sequence[bytes], names: set[bytes]) -> Transaction[dict[bytes, list[int]]]:
        """Write lines, and return the replies by name once all commands are confirmed."""
        commands, confirmed = sum(line[:1] in b"!^" for line in lines), 0
        values: dict[bytes, list[int]] = {}
        frame = yield b"".join(line + b"\r" for line in lines)
        while True:
            confirmed += frame == b"+"
            if frame == b"-":
                raise DriverError(f"it rejected one of {b', '.join(lines).decode()}; check its configuration")
            if reply := _REPLY.fullmatch(frame):
                values[reply[1]] = [int(number) for number in reply[2].split(b":")]
            if confirmed >= commands and names <= values.keys():
                return values
            frame = yield b""
