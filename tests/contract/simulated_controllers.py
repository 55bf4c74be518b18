"""Simulated firmware of each kind of controller; sources as in its module in drivers.motors.protocols."""

from __future__ import annotations

import contextlib
import math
import os
import re
import select
import struct
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final, Protocol

from drivers.motor import VelocityCommand
from drivers.motors.protocols.line_protocol import BUMPER, CLIFF, SEQ_COUNT, decode, encode
from drivers.motors.protocols.motor_protocol import DifferentialDrive, Framer, T, TextFramer, Transaction
from drivers.motors.protocols.odrive_ascii import CLOSED_LOOP, WATCHDOG_EXPIRED, with_checksum
from drivers.motors.protocols.roboteq import MAX_RPM
from drivers.motors.protocols.vesc import (
    FORWARD_CAN,
    GET_APPCONF,
    GET_VALUES_SELECTIVE,
    SET_RPM,
    PacketFramer,
    packet,
)
from drivers.motors.serial_motor import PROTOCOLS, SerialMotor
from drivers.motors.simulated_motor import STEP_S, SimulatedBase

LEFT, RIGHT = SIDES = (0, 1)


class FirmwareBase(SimulatedBase):
    """Wheels, each with its own watchdog, that need a stop after it has expired, and count what a controller receives.

    watchdog_ms 0 is off.
    """

    def __init__(self, drive: DifferentialDrive | None = None) -> None:
        super().__init__(drive or DifferentialDrive(), 500.0)
        self.fault = 0
        self.bumper = self.cliff = False  # contacts that it reports
        self.battery_v = 12.0
        self.expired = [False, False]  # watchdogs: left, right
        self._fed_s = [0.0, 0.0]  # time since each watchdog was fed
        self.commands = self.errors = 0  # valid commands, and all that a real controller would reject
        self.expiries = 0  # times that the watchdog has stopped the wheels
        self.unsafe_resumes = 0  # motion commands to a wheel that needed a stop first
        self._needs_stop = [False, False]
        self.travel_m = [0.0, 0.0]  # left and right wheel
        self.traction = self._roll

    def _roll(self, _: float, left_m: float, right_m: float) -> tuple[float, float]:
        self.travel_m = [self.travel_m[LEFT] + left_m, self.travel_m[RIGHT] + right_m]
        return left_m, right_m

    @property
    def last_command(self) -> VelocityCommand:
        """The last commanded motion, with stamp and heading 0."""
        left_mps, right_mps = self.commanded_mps
        return VelocityCommand(0, (left_mps + right_mps) / 2, 0.0, (right_mps - left_mps) / self.drive.track_m)

    def command(self, velocity_mps: float, yaw_rate_radps: float) -> None:
        super().command(velocity_mps, yaw_rate_radps)
        for side, speed_mps in enumerate(self.commanded_mps):
            self.command_wheel(side, speed_mps)

    def command_wheel(self, side: int, speed_mps: float) -> None:
        """Command the speed of one wheel, forward positive, and feed its watchdog."""
        is_unsafe = self._needs_stop[side] and speed_mps != 0.0
        self.unsafe_resumes += is_unsafe
        self.errors += is_unsafe
        self._needs_stop[side] = False
        self.commanded_mps[side] = speed_mps
        self.set_expired(side, expired=False)
        self.feed(side)

    def feed(self, side: int) -> None:
        """Feed the watchdog of one wheel."""
        self._fed_s[side] = 0.0

    def expire(self, side: int) -> None:
        """Let the watchdog of one wheel stop it."""
        self.expiries += not self.watchdog_expired
        self._needs_stop[side] = True
        self.commanded_mps[side] = 0.0
        self.set_expired(side, expired=True)

    def set_expired(self, side: int, *, expired: bool) -> None:
        """Note whether the watchdog of one wheel has expired."""
        self.expired[side] = expired
        self.watchdog_expired = any(self.expired)

    def watch(self, dt_s: float) -> None:
        for side in SIDES:
            self._fed_s[side] += dt_s
            if 0.0 < self.watchdog_ms < self._fed_s[side] * 1000 and not self.expired[side]:
                self.expire(side)


class SimulatedController(Protocol):
    """Simulated firmware: receives and sends bytes, and turns the wheels. Invalid frames are counted as errors."""

    @property
    def base(self) -> FirmwareBase:
        """The simulated base."""

    def feed(self, data: bytes) -> bytes:
        """Return the replies to received bytes."""


def side_of(base: FirmwareBase, channel: int) -> int:
    """Return the wheel, LEFT or RIGHT, of a channel, 0 or 1."""
    return RIGHT if bool(channel) != base.drive.swapped else LEFT


def command_channel(base: FirmwareBase, channel: int, speed_mps: float) -> None:
    """Command the speed of one channel, 0 or 1."""
    side = side_of(base, channel)
    base.command_wheel(side, base.drive.to_sides(speed_mps, speed_mps)[side])


def channels_mps(base: SimulatedBase) -> tuple[float, float]:
    """Return the speeds of the channels."""
    half_mps = base.yaw_rate_radps * base.drive.track_m / 2
    return base.drive.to_channels(base.velocity_mps - half_mps, base.velocity_mps + half_mps)


class SimulatedFirmware:
    """Simulated firmware of one kind of controller: handles frames, and turns the wheels of its base."""

    def __init__(self, drive: DifferentialDrive | None, framer: Framer) -> None:
        self.base, self._framer = FirmwareBase(drive), framer

    def feed(self, data: bytes) -> bytes:
        """Return the replies to all frames that end in data."""
        return b"".join(self.handle(frame) for frame in self._framer.feed(data))

    def handle(self, frame: bytes) -> bytes:
        """Return the reply to a frame, empty without one."""
        raise NotImplementedError

    def _reject(self, reply: bytes) -> bytes:
        """Count an error and return the reply to it."""
        self.base.errors += 1
        return reply


class SimulatedLine(SimulatedFirmware):
    """Own firmware; heading_input: steer to the commanded heading, else follow the commanded yaw rate."""

    def __init__(self, drive: DifferentialDrive | None = None, *, heading_input: bool = True) -> None:
        super().__init__(drive, TextFramer())
        self._heading_input = heading_input
        self._zero_rad = 0.0  # heading in the world at which the controller's heading is 0
        self._next_seq: int | None = None

    def handle(self, frame: bytes) -> bytes:
        """Return the reply to a frame, empty without one."""
        kind, numbers = decode(frame) or ("", ())
        if kind == "V":
            return self._drive(*numbers)
        if kind != "W":
            return self._reject(b"")
        # A connection: stop, count the present heading as 0, accept any seq as the first one.
        self.base.watchdog_ms = numbers[0]
        self._next_seq, self._zero_rad = None, self.base.pose[2]
        self.base.command(0.0, 0.0)
        return encode("A", numbers[0])

    def _drive(self, seq: int, velocity: int, heading: int, yaw_rate: int) -> bytes:
        base = self.base
        base.errors += self._next_seq not in (None, seq)
        self._next_seq = (seq + 1) % SEQ_COUNT
        base.commands += 1
        turned_rad = math.remainder(base.pose[2] - self._zero_rad, math.tau)
        measured = (round(value * 1000) for value in (base.velocity_mps, turned_rad, base.yaw_rate_radps))
        contact = BUMPER * base.bumper + CLIFF * base.cliff
        state = round(base.battery_v * 1000), base.fault, int(base.watchdog_expired), contact
        reply = encode("S", seq, *measured, *state)
        steers = self._heading_input and (velocity or yaw_rate)
        base.goal_heading_rad = heading / 1000 + self._zero_rad if steers else None
        base.command(velocity / 1000, yaw_rate / 1000)
        return reply


class SimulatedRoboteq(SimulatedFirmware):
    """One controller; by default it echoes, as a real one does."""

    def __init__(self, drive: DifferentialDrive | None = None) -> None:
        super().__init__(drive, TextFramer())
        self.base.watchdog_ms = 1000
        self._echo = True

    def handle(self, frame: bytes) -> bytes:
        """Return the reply to a frame, empty without one."""
        echo = frame + b"\r" if self._echo else b""
        return echo + (self._reply(frame) or self._reject(b"-")) + b"\r"

    def _reply(self, line: bytes) -> bytes | None:
        base, rpm_per_mps = self.base, self.base.drive.rpm_per_mps
        if command := re.fullmatch(rb"!S ([12]) (-?[0-9]{1,5})", line):
            if abs(int(command[2])) > MAX_RPM:
                return None
            base.commands += 1
            command_channel(base, int(command[1]) - 1, int(command[2]) / rpm_per_mps)
            return b"+"
        if setting := re.fullmatch(rb"\^(ECHOF|RWD) ([0-9]{1,5})", line):
            if setting[1] == b"ECHOF":
                self._echo = int(setting[2]) == 0
            else:
                base.watchdog_ms = int(setting[2])
            return b"+"
        return {
            b"?S": b"S=%d:%d" % tuple(round(mps * rpm_per_mps) for mps in channels_mps(base)),
            b"?V 2": b"V=%d" % round(base.battery_v * 10),
            b"?FF": b"FF=%d" % base.fault,
            b"~RWD": b"RWD=%d" % base.watchdog_ms,
            b"~MXMD": b"MXMD=0",
        }.get(line)


_FLOAT = r"(-?[0-9]{1,6}(?:\.[0-9]{1,6})?)"
_ODRIVE_LINE = re.compile(rf"([vuf]) ([01])(?: {_FLOAT})?|([rw]) (\S+)(?: {_FLOAT})?")
_IDLE = 1


class SimulatedODrive(SimulatedFirmware):
    """One board. It requires a checksum on every line, which is optional for a real one, to detect damaged lines."""

    def __init__(self, drive: DifferentialDrive | None = None) -> None:
        super().__init__(drive, TextFramer())
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
        body = frame.rpartition(b"*")[0].decode("latin-1")
        if not body.isascii() or with_checksum(body).rstrip() != frame:
            return self._reject(b"")
        for axis in SIDES:
            if self.base.expired[side_of(self.base, axis)]:
                self._state[axis] = _IDLE
        match = _ODRIVE_LINE.fullmatch(body)
        reply = self._reply(*match.groups()) if match else self._reject(b"unknown command")
        return with_checksum(reply.decode()).replace(b"\n", b"\r\n") if reply else b""

    def _reply(
        self, of_axis: str | None, axis: str | None, speed: str | None, access: str | None, name: str, value: str | None
    ) -> bytes:
        """Return the reply to a command of an axis, or to the reading or writing of a property."""
        if access is not None:
            return self._read(name) if access == "r" else self._write(name, float(value or 0))
        number = int(axis or 0)
        turns_per_m = self.base.drive.turns_per_m
        if of_axis == "f":
            return b"%.6f %.6f" % (
                self.base.drive.to_channels(*self.base.travel_m)[number] * turns_per_m,
                channels_mps(self.base)[number] * turns_per_m,
            )
        self.base.feed(side_of(self.base, number))
        if of_axis == "v":  # a disarmed axis does not turn
            self.base.commands += 1
            self._input_vel[number] = float(speed or 0)
            if self._state[number] == CLOSED_LOOP:
                command_channel(self.base, number, self._input_vel[number] / turns_per_m)
        return b""

    def _read(self, name: str) -> bytes:
        values = {**self._settings, "vbus_voltage": self.base.battery_v}
        for axis in SIDES:
            expired = self.base.expired[side_of(self.base, axis)]
            values[f"axis{axis}.current_state"] = self._state[axis]
            values[f"axis{axis}.error"] = self.base.fault | WATCHDOG_EXPIRED * expired
        return b"%g" % values[name] if name in values else self._reject(b"invalid property")

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
        side = side_of(self.base, axis)
        if name == "error":
            self.base.set_expired(side, expired=bool(int(value) & WATCHDOG_EXPIRED))
        elif value == CLOSED_LOOP and not self.base.expired[side] and not self.base.fault:
            self._state[axis] = CLOSED_LOOP
            command_channel(self.base, axis, self._input_vel[axis] / self.base.drive.turns_per_m)
        return b""


_LOCAL_ID = 77  # CAN id of the controller on the serial port.
_ALIVE = 30  # COMM_ALIVE
_ARGUMENT_BYTES = {SET_RPM: 4, GET_APPCONF: 0, _ALIVE: 0, GET_VALUES_SELECTIVE: 4}
_SIGNATURE = 0x1234ABCD  # any: the driver ignores it


class SimulatedVesc(SimulatedFirmware):
    """A pair of controllers; timeout_ms: of both, as set by VESC Tool."""

    def __init__(self, drive: DifferentialDrive | None = None, timeout_ms: int = 500) -> None:
        super().__init__(drive, PacketFramer())
        self.base.watchdog_ms = timeout_ms

    def handle(self, frame: bytes) -> bytes:
        """Pass the payload to the controller on the port or on CAN; no reply for an unknown id."""
        if frame[0] != FORWARD_CAN:
            return self._reply(0, frame)
        if len(frame) > 2 and frame[1] == self.base.drive.can_id:
            return self._reply(1, frame[2:])
        return self._reject(b"")

    def _reply(self, channel: int, payload: bytes) -> bytes:
        base = self.base
        can_id = base.drive.can_id if channel else _LOCAL_ID
        erpm_per_mps = base.drive.rpm_per_mps * base.drive.pole_pairs
        if _ARGUMENT_BYTES.get(payload[0]) != len(payload) - 1:
            return self._reject(b"")
        if payload[0] == GET_APPCONF:  # signature, id, timeout, and a filling that makes it a long packet
            head = struct.pack(">BIBI", GET_APPCONF, _SIGNATURE, can_id, round(base.watchdog_ms))
            return packet(head + bytes(range(256)) + bytes(150))
        if payload[0] == GET_VALUES_SELECTIVE:
            fields = {  # bit of the mask -> value
                7: struct.pack(">i", round(channels_mps(base)[channel] * erpm_per_mps)),
                8: struct.pack(">h", round(base.battery_v * 10)),
                15: bytes((base.fault,)),
                17: bytes((can_id,)),
                21: bytes((base.expired[side_of(base, channel)],)),
            }
            (mask,) = struct.unpack(">I", payload[1:])
            return packet(payload + b"".join(data for bit, data in fields.items() if mask >> bit & 1))
        if payload[0] == SET_RPM:
            base.commands += 1
            command_channel(base, channel, struct.unpack(">i", payload[1:])[0] / erpm_per_mps)
        else:
            base.feed(side_of(base, channel))
        return b""


SIMULATED_CONTROLLERS: Final[Mapping[str, Callable[[DifferentialDrive], SimulatedController]]] = {
    "line": SimulatedLine,
    "roboteq": SimulatedRoboteq,
    "odrive_ascii": SimulatedODrive,
    "vesc": SimulatedVesc,
}


# Simulated controllers, directly and on a pseudo-terminal in real time, for the serial driver


READ_LIMIT_BYTES = 4096
LONGEST_ABSENCE_S = 0.05  # a thread that was not scheduled for longer does not advance: the host was not late


class PtyMotor:
    """A controller on a pty in real time; a thread stands for the processor of the real device."""

    def __init__(self, controller: SimulatedController | None = None) -> None:
        """Open the pty; `port` is the path for the driver."""
        self.controller = controller or SimulatedLine()
        self.drop_replies = False  # fault: commands are carried out without a reply
        self.drop_input = False  # fault: received bytes are ignored
        self.garbage = b""  # fault: sent before each reply
        device, self._host = os.openpty()
        tty.setraw(self._host)  # kept open: without an open host side, reads of the device side fail
        os.set_blocking(device, False)
        self._device = device
        # A name of its own, as udev gives it: the system gives the number of a closed pty to the next one that opens.
        self._folder = tempfile.TemporaryDirectory(prefix="omnid-motor-")
        os.chmod(self._folder.name, 0o755)  # other users may try to open it
        self.port = str(Path(self._folder.name, "tty"))
        os.symlink(os.ttyname(self._host), self.port)
        self._expiring = threading.Event()
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="simulated-motor", daemon=True)
        self._thread.start()

    @property
    def base(self) -> FirmwareBase:
        """The simulated base."""
        return self.controller.base

    def expire(self) -> None:
        """Let the watchdog stop the wheels at once."""
        self._expiring.set()
        while self._expiring.is_set() and self._thread.is_alive():
            time.sleep(STEP_S)

    def send(self, data: bytes) -> None:
        """Send bytes; drop them where the host does not read."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._device, data)

    def close(self) -> None:
        """End the thread and close the pty; a second call does nothing."""
        if not self._thread.is_alive():
            return
        os.write(self._wake_write, b"x")
        self._thread.join()
        self._folder.cleanup()
        for descriptor in (self._device, self._host, self._wake_read, self._wake_write):
            os.close(descriptor)

    def _serve(self) -> None:
        last_s = time.monotonic()
        while True:
            readable, _, _ = select.select([self._wake_read, self._device], [], [], STEP_S)
            now_s = time.monotonic()
            self.base.advance(min(now_s - last_s, LONGEST_ABSENCE_S))
            last_s = now_s
            if self._wake_read in readable:
                return
            if self._expiring.is_set():
                for side in SIDES:
                    self.base.expire(side)
                self._expiring.clear()
            if readable:
                self._receive(os.read(self._device, READ_LIMIT_BYTES))

    def _receive(self, data: bytes) -> None:
        if self.drop_input:
            return
        replies = self.controller.feed(data)
        if replies and not self.drop_replies:
            self.send(self.garbage + replies)


NAMES = sorted(PROTOCOLS)
PATIENCE_S = 20.0  # bounds a wait on a loaded machine; not a measured limit
REPLY_S = 2.0
LONG_MS = 10_000
SHORT_MS = 100
BASE = DifferentialDrive(track_m=0.4, wheel_radius_m=0.08, max_wheel_mps=1.0, gear=12.0)


def controller_of(name: str, drive: DifferentialDrive = BASE, watchdog_ms: int = LONG_MS) -> SimulatedController:
    """Return the simulated controller; it follows the yaw rate even where it could steer to a heading."""
    if name == "vesc":
        return SimulatedVesc(drive, watchdog_ms)
    return SimulatedLine(drive, heading_input=False) if name == "line" else SIMULATED_CONTROLLERS[name](drive)


def run(transaction: Transaction[T], controller: SimulatedController, framer: Framer) -> T:
    """Run a transaction with a simulated controller and return its result."""
    try:
        data = next(transaction)
        while True:
            frames = framer.feed(controller.feed(data))
            assert frames, "the simulated controller does not reply"
            data = b"".join([transaction.send(frame) for frame in frames])
    except StopIteration as done:
        return done.value  # type: ignore[no-any-return]


@contextlib.contextmanager
def connected_motor(
    name: str, drive: DifferentialDrive = BASE, *, watchdog_ms: int = LONG_MS, timeout_s: float = REPLY_S
) -> Iterator[tuple[SerialMotor, PtyMotor]]:
    """Yield a driver and the simulated motor that it is connected to."""
    with contextlib.closing(PtyMotor(controller_of(name, drive, watchdog_ms))) as simulated:
        protocol = PROTOCOLS[name](drive)
        motor = SerialMotor(simulated.port, protocol, timeout_s=timeout_s, watchdog_ms=watchdog_ms,
                            connect_s=PATIENCE_S)  # fmt: skip
        with contextlib.closing(motor):
            yield motor, simulated


def until(condition: Callable[[], bool]) -> bool:
    """Wait for a condition; False if it is not met in time."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.005)
    return False
