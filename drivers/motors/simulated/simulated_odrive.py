"""Simulated ODrive v3 with two axes; sources as in drivers/motors/protocols/odrive_ascii.py."""

from __future__ import annotations

import math
import re

from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.motor_protocol import TextFramer
from drivers.motors.simulated.simulated_base import SIDES, SimulatedBase, SimulatedFirmware

_FLOAT = r"(-?[0-9]{1,6}(?:\.[0-9]{1,6})?)"
_WATCHDOG_EXPIRED, _CLOSED_LOOP, _IDLE = 0x800, 8, 1


class SimulatedODrive(SimulatedFirmware):
    """One board. It requires a checksum on every line, which is optional for a real one, to detect damaged lines."""

    def __init__(self, drive: DifferentialDrive | None = None) -> None:
        super().__init__(SimulatedBase(drive), TextFramer())
        self.base.watchdog_ms = 0
        self._state = [_IDLE, _IDLE]
        self._input_vel = [0.0, 0.0]  # turns/s; set while an axis is disarmed too, in force once it is armed
        self._settings = {
            f"axis{axis}.{name}": 0.0
            for axis in SIDES
            for name in ("config.enable_watchdog", "config.watchdog_timeout", "controller.config.control_mode")
        }

    def _handle(self, frame: bytes) -> bytes:
        body, star, checksum = frame.partition(b"*")
        if not star or not re.fullmatch(rb"[0-9]{1,3}", checksum) or int(checksum) != _xor(body):
            return self._reject(b"")
        reply = self._reply(body.decode("latin-1"))
        return b"%b*%d\r\n" % (reply, _xor(reply)) if reply else b""

    def _reply(self, line: str) -> bytes:
        self._disarm_expired()
        if match := re.fullmatch(rf"v ([01]) {_FLOAT}", line):
            self.base.commands += 1
            return self._drive(int(match[1]), float(match[2]))
        if match := re.fullmatch(r"u ([01])", line):
            return self._feed_axis(int(match[1]))
        if match := re.fullmatch(r"f ([01])", line):
            turns = self._turns_per_m()
            axis = int(match[1])
            return b"%.6f %.6f" % (self.base.channels_m()[axis] * turns, self.base.channels_mps()[axis] * turns)
        if match := re.fullmatch(r"r (\S+)", line):
            return self._read(match[1])
        if match := re.fullmatch(rf"w (\S+) {_FLOAT}", line):
            return self._write(match[1], float(match[2]))
        return self._reject(b"unknown command")

    def _drive(self, axis: int, turns_per_s: float) -> bytes:
        """Set the velocity and feed the watchdog; a disarmed axis does not turn."""
        self._input_vel[axis] = turns_per_s
        self._feed_axis(axis)
        if self._state[axis] == _CLOSED_LOOP:
            self.base.command_channel(axis, turns_per_s / self._turns_per_m())
        return b""

    def _feed_axis(self, axis: int) -> bytes:
        self.base.feed(self.base.side_of(axis))
        return b""

    def _read(self, name: str) -> bytes:
        if name == "vbus_voltage":
            return b"%f" % self.base.battery_v
        if match := re.fullmatch(r"axis([01])\.error", name):
            expired = self.base.expired[self.base.side_of(int(match[1]))]
            return b"%d" % (self.base.fault | _WATCHDOG_EXPIRED * expired)
        return b"%g" % self._settings[name] if name in self._settings else self._reject(b"invalid property")

    def _write(self, name: str, value: float) -> bytes:
        if match := re.fullmatch(r"axis([01])\.(error|requested_state)", name):
            return self._arm(int(match[1]), match[2], value)
        if name not in self._settings:
            return self._reject(b"invalid property")
        self._settings[name] = value
        times_s = [self._settings[f"axis{axis}.config.watchdog_timeout"] for axis in SIDES]
        enabled = all(self._settings[f"axis{axis}.config.enable_watchdog"] for axis in SIDES)
        self.base.watchdog_ms = 1000 * max(times_s) if enabled else 0.0
        return b""

    def _arm(self, axis: int, name: str, value: float) -> bytes:
        side = self.base.side_of(axis)
        if name == "error":
            self.base.expired[side] = bool(int(value) & _WATCHDOG_EXPIRED)
        elif value == _CLOSED_LOOP and not self.base.expired[side] and not self.base.fault:
            self._state[axis] = _CLOSED_LOOP
            self.base.command_channel(axis, self._input_vel[axis] / self._turns_per_m())
        return b""

    def _disarm_expired(self) -> None:
        for axis in SIDES:
            if self.base.expired[self.base.side_of(axis)]:
                self._state[axis] = _IDLE

    def _turns_per_m(self) -> float:
        return self.base.drive.gear / (math.tau * self.base.drive.wheel_radius_m)


def _xor(data: bytes) -> int:
    checksum = 0
    for byte in data:
        checksum ^= byte
    return checksum
