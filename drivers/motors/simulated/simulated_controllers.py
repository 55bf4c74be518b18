"""Simulated firmware of each kind of controller; sources as in its module in drivers.motors.protocols."""

from __future__ import annotations

import math
import re
import struct

from drivers.motor import MotorStatus, VelocityCommand, is_stop
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.line_protocol import (
    SEQ_COUNT,
    LineFramer,
    ProtocolError,
    StatusMessage,
    VelocityMessage,
    WatchdogReply,
    WatchdogRequest,
    decode,
    encode,
)
from drivers.motors.protocols.motor_protocol import TextFramer
from drivers.motors.protocols.roboteq import MAX_RPM, S_PER_MIN
from drivers.motors.protocols.vesc import PacketFramer
from drivers.motors.simulated.simulated_base import SIDES, MotionLimits, SimulatedBase, SimulatedFirmware


class SimulatedLine(SimulatedFirmware):
    """One controller; heading_input: steer to the commanded heading, else follow the commanded yaw rate."""

    def __init__(
        self, drive: DifferentialDrive | None = None, *, heading_input: bool = True, limits: MotionLimits | None = None
    ) -> None:
        super().__init__(SimulatedBase(drive, limits), LineFramer())
        self._heading_input = heading_input
        self._zero_rad = 0.0  # heading in the world at which the controller's heading is 0
        self._next_seq: int | None = None

    def handle(self, frame: bytes) -> bytes:
        """Return the reply to a frame, empty without one."""
        try:
            message = decode(frame)
        except ProtocolError:
            return self._reject(b"")
        match message:
            case VelocityMessage(seq, command):
                return self._drive(seq, command)
            case WatchdogRequest(watchdog_ms):
                return self._connect(watchdog_ms)
        return self._reject(b"")

    def _drive(self, seq: int, command: VelocityCommand) -> bytes:
        self.base.errors += self._next_seq not in (None, seq)
        self._next_seq = (seq + 1) % SEQ_COUNT
        self.base.commands += 1
        reply = encode(StatusMessage(seq, self._status()))
        steers = self._heading_input and not is_stop(command)
        self.base.goal_heading_rad = command.heading_rad + self._zero_rad if steers else None
        self.base.command(command.velocity_mps, command.yaw_rate_radps)
        return reply

    def _connect(self, watchdog_ms: int) -> bytes:
        """Start a connection: stop, set the present heading to 0, accept any seq as the first one."""
        self.base.watchdog_ms = watchdog_ms
        self._next_seq = None
        self._zero_rad = self.base.pose[2]
        self.base.command(0.0, 0.0)
        return encode(WatchdogReply(watchdog_ms))

    def _status(self) -> MotorStatus:
        base = self.base
        heading_rad = math.remainder(base.pose[2] - self._zero_rad, math.tau)
        return MotorStatus(
            base.velocity_mps,
            heading_rad,
            base.yaw_rate_radps,
            base.watchdog_expired,
            base.fault,
            base.battery_v,
            base.bumper,
            base.cliff,
        )


_COMMAND = re.compile(rb"!S ([12]) (-?[0-9]{1,5})")


class SimulatedRoboteq(SimulatedFirmware):
    """One controller; by default it echoes, as a real one does."""

    def __init__(self, drive: DifferentialDrive | None = None) -> None:
        super().__init__(SimulatedBase(drive), TextFramer())
        self.base.watchdog_ms = 1000
        self._echo = True

    def handle(self, frame: bytes) -> bytes:
        """Return the reply to a frame, empty without one."""
        echo = frame + b"\r" if self._echo else b""
        return echo + (self._reply(frame) or self._reject(b"-")) + b"\r"

    def _reply(self, line: bytes) -> bytes | None:
        if command := _COMMAND.fullmatch(line):
            return self._drive(int(command[1]) - 1, int(command[2]))
        if setting := re.fullmatch(rb"\^(ECHOF|RWD) ([0-9]{1,5})", line):
            return self._set(setting[1], int(setting[2]))
        return self._query(line)

    def _drive(self, channel: int, rpm: int) -> bytes | None:
        if abs(rpm) > MAX_RPM:
            return None
        self.base.commands += 1
        self.base.command_channel(channel, rpm * self._mps_per_rpm())
        return b"+"

    def _set(self, name: bytes, value: int) -> bytes:
        if name == b"ECHOF":
            self._echo = value == 0
        else:
            self.base.watchdog_ms = value
        return b"+"

    def _query(self, line: bytes) -> bytes | None:
        speeds = b":".join(b"%d" % round(mps / self._mps_per_rpm()) for mps in self.base.channels_mps())
        return {
            b"?S": b"S=" + speeds,
            b"?V 2": b"V=%d" % round(self.base.battery_v * 10),
            b"?FF": b"FF=%d" % self.base.fault,
            b"~RWD": b"RWD=%d" % self.base.watchdog_ms,
            b"~MXMD": b"MXMD=0",
        }.get(line)

    def _mps_per_rpm(self) -> float:
        """Return the wheel speed of one rpm of the motor."""
        return math.tau * self.base.drive.wheel_radius_m / (S_PER_MIN * self.base.drive.gear)


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

    def handle(self, frame: bytes) -> bytes:
        """Return the reply to a frame, empty without one."""
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
        if match := re.fullmatch(r"axis([01])\.current_state", name):
            return b"%d" % self._state[int(match[1])]
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


_LOCAL_ID = 77  # CAN id of the controller on the serial port.
_SET_RPM, _GET_APPCONF, _ALIVE, _FORWARD_CAN, _GET_VALUES_SELECTIVE = 8, 17, 30, 34, 50  # COMM_PACKET_ID
_ARGUMENT_BYTES = {_SET_RPM: 4, _GET_APPCONF: 0, _ALIVE: 0, _GET_VALUES_SELECTIVE: 4}
_SIGNATURE = 0x1234ABCD  # any: the driver ignores it
_CRC_POLYNOMIAL = 0x1021


class SimulatedVesc(SimulatedFirmware):
    """A pair of controllers; timeout_ms: of both, as set by VESC Tool."""

    def __init__(self, drive: DifferentialDrive | None = None, timeout_ms: int = 500) -> None:
        super().__init__(SimulatedBase(drive), PacketFramer())
        self.base.watchdog_ms = timeout_ms

    def handle(self, frame: bytes) -> bytes:
        """Pass the payload to the controller on the port or on CAN; no reply for an unknown id."""
        if frame[0] != _FORWARD_CAN:
            return self._reply(0, frame)
        if len(frame) > 2 and frame[1] == self.base.drive.can_id:
            return self._reply(1, frame[2:])
        return self._reject(b"")

    def _reply(self, channel: int, payload: bytes) -> bytes:
        if _ARGUMENT_BYTES.get(payload[0]) != len(payload) - 1:
            return self._reject(b"")
        if payload[0] == _SET_RPM:
            self._drive(channel, struct.unpack(">i", payload[1:])[0])
        elif payload[0] == _ALIVE:
            self.base.feed(self.base.side_of(channel))
        elif payload[0] == _GET_APPCONF:
            return _packet(self._config(channel))
        else:
            return _packet(self._values(channel, struct.unpack(">I", payload[1:])[0]))
        return b""

    def _drive(self, channel: int, erpm: int) -> None:
        self.base.commands += 1
        self.base.command_channel(channel, erpm / self._erpm_per_mps())

    def _config(self, channel: int) -> bytes:
        """Return signature, id, timeout, and a filling that makes it a long packet."""
        head = struct.pack(">BIBI", _GET_APPCONF, _SIGNATURE, self._id(channel), round(self.base.watchdog_ms))
        return head + bytes(range(256)) + bytes(150)

    def _values(self, channel: int, mask: int) -> bytes:
        fields = {  # bit of the mask -> value
            7: struct.pack(">i", round(self.base.channels_mps()[channel] * self._erpm_per_mps())),
            8: struct.pack(">h", round(self.base.battery_v * 10)),
            15: bytes((self.base.fault,)),
            17: bytes((self._id(channel),)),
            21: bytes((self.base.expired[self.base.side_of(channel)],)),
        }
        wanted = [data for bit, data in fields.items() if mask >> bit & 1]
        return struct.pack(">BI", _GET_VALUES_SELECTIVE, mask) + b"".join(wanted)

    def _id(self, channel: int) -> int:
        return self.base.drive.can_id if channel else _LOCAL_ID

    def _erpm_per_mps(self) -> float:
        drive = self.base.drive
        return S_PER_MIN * drive.pole_pairs * drive.gear / (math.tau * drive.wheel_radius_m)


def _packet(payload: bytes) -> bytes:
    """Return the packet of a payload; the CRC is computed bit by bit, to check the driver's."""
    crc = 0
    for byte in payload:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ _CRC_POLYNOMIAL if crc & 0x8000 else crc << 1) & 0xFFFF
    size = len(payload)
    head = bytes((2, size)) if size < 256 else bytes((3, size >> 8, size & 255))
    return head + payload + bytes((crc >> 8, crc & 255, 3))
