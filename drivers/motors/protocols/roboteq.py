"""Roboteq dual-channel controllers: commands <-> ASCII lines, no I/O.

Source: Roboteq Controllers User Manual, chapters "Serial (RS232/USB) operation" and "Commands Reference".

    "!S ch rpm"    closed-loop speed of a channel, -65535 .. 65535
    "!G ch n"      power (open loop) or share of the greatest speed, -1000 .. 1000; with mixing on, channel 1 is the
                   throttle and channel 2 the steering: motor 1 gets their sum, motor 2 their difference
    "^RWD ms"      serial watchdog, read back by "~RWD"; 0 is off. Only "!" commands feed it, and the next one drives
                   again, which is why the driver sends a stop first
    "^ECHOF 1"     no echo; echoed lines are skipped until it is in force
    "?S" "?M"      speeds in rpm, applied commands in thousandths; "?V 2" battery in 0.1 V; "?FF" fault flags

Each line ends in CR; "+" confirms, "-" rejects, the reply to a query is "NAME=value:value". All lines of a command
are written at once: on a USB adapter each round trip may take 16 ms (the default latency timer of FTDI's chips).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.motor_protocol import TextFramer, Transaction, require_watchdog

RPM, POWER, MIXED = "rpm", "power", "mixed"
FULL = 1000  # full scale of "!G"
MAX_RPM = 65535
S_PER_MIN = 60

_REPLY = re.compile(rb"([A-Z]{1,6})=(-?[0-9]{1,10}(?::-?[0-9]{1,10}){0,9})")
_ECHO = re.compile(rb"[!^~?%#].*", re.DOTALL)


class Roboteq:
    """One dual-channel controller, commanded by speeds (rpm), powers, or throttle and steering (mixed)."""

    baud = 115_200

    def __init__(self, drive: DifferentialDrive, mode: str = RPM) -> None:
        self.bad_frames = 0
        self._drive, self._mode = drive, mode

    def framer(self) -> TextFramer:
        """Return a framer of lines."""
        return TextFramer()

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Set the serial watchdog, read it back and return the time in force [ms].

        Raises DriverError where another time is in force, or the mixing mode does not match the protocol.
        """
        lines = [b"^ECHOF 1", b"^RWD %d" % watchdog_ms, b"~RWD", b"~MXMD"]
        values = yield from self._query(lines, {b"RWD", b"MXMD"})
        if (self._mode == MIXED) != bool(values[b"MXMD"][0]):
            wanted = "on" if self._mode == MIXED else "off"
            raise DriverError(
                f"its mixing mode is {values[b'MXMD'][0]}; switch mixing {wanted}, or choose another protocol: "
                "roboteq_mixed with mixing, roboteq or roboteq_power without"
            )
        require_watchdog(watchdog_ms, values[b"RWD"][0])
        return values[b"RWD"][0]

    def drive(self, command: VelocityCommand, now_s: float) -> Transaction[MotorStatus]:
        """Send the commands of both channels and the queries at once, and return the status."""
        query = b"S" if self._mode == RPM else b"M"
        lines = [*self._commands(command), b"?" + query, b"?V 2", b"?FF"]
        values = yield from self._query(lines, {query, b"V", b"FF"})
        velocity_mps, yaw_rate_radps = self._motion(values[query])
        battery_v = values[b"V"][-1] / 10
        return MotorStatus(velocity_mps, float("nan"), yaw_rate_radps, False, values[b"FF"][0], battery_v)

    def _commands(self, command: VelocityCommand) -> list[bytes]:
        if self._mode == RPM:
            rpm_per_mps = S_PER_MIN * self._drive.turns_per_m
            speeds = self._drive.channels(command, MAX_RPM / rpm_per_mps)
            return [b"!S %d %d" % (channel, round(mps * rpm_per_mps)) for channel, mps in enumerate(speeds, 1)]
        first, second = (FULL * mps / self._drive.max_wheel_mps for mps in self._drive.channels(command))
        if self._mode == MIXED:
            first, second = (first + second) / 2, (first - second) / 2
        return [b"!G %d %d" % (channel, round(power)) for channel, power in enumerate((first, second), 1)]

    def _motion(self, values: Sequence[int]) -> tuple[float, float]:
        if len(values) < 2:
            raise DriverError("it has one channel; a base needs two")
        rpm_mps = 1 / (S_PER_MIN * self._drive.turns_per_m)
        unit_mps = rpm_mps if self._mode == RPM else self._drive.max_wheel_mps / FULL
        return self._drive.motion(values[0] * unit_mps, values[1] * unit_mps)

    def _query(self, lines: Sequence[bytes], names: set[bytes]) -> Transaction[dict[bytes, list[int]]]:
        """Write lines, and return the replies by name once all commands are confirmed."""
        unconfirmed = sum(line[:1] in b"!^" for line in lines)
        values: dict[bytes, list[int]] = {}
        frame = yield b"".join(line + b"\r" for line in lines)
        while True:
            unconfirmed -= frame == b"+"
            if frame == b"-":
                raise DriverError(f"it rejected one of {b', '.join(lines).decode()}; check its configuration")
            if reply := _REPLY.fullmatch(frame):
                values[reply[1]] = [int(number) for number in reply[2].split(b":")]
            elif frame != b"+" and not _ECHO.fullmatch(frame):
                self.bad_frames += 1
            if unconfirmed <= 0 and names <= values.keys():
                return values
            frame = yield b""
