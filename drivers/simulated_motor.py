"""The twin of a line-protocol base: a controller with wheels that checks every byte, served on a real pty."""

from __future__ import annotations

import contextlib
import math
import os
import select
import threading
import time
import tty
from dataclasses import dataclass

from drivers.errors import DriverError
from drivers.line_protocol import (
    SEQ_COUNT,
    LineAssembler,
    ProtocolError,
    SetWatchdog,
    Status,
    Velocity,
    WatchdogSet,
    decode,
    encode,
)
from drivers.motor import MotorStatus, VelocityCommand, is_stop, stop_command

STEP_S = 0.005
LONGEST_ADVANCE_S = 60.0
READ_LIMIT_BYTES = 4096
Pose = tuple[float, float, float]  # x [m], y [m], heading [rad]


@dataclass(frozen=True, slots=True)
class TwinLimits:
    """What the wheels can do."""

    acceleration_mps2: float = 2.0
    yaw_rate_radps: float = 2.0
    yaw_acceleration_radps2: float = 8.0
    heading_gain_hz: float = 3.0


class TwinState:
    """Controller and base as pure state: time passes only by `advance`.

    heading_input: steers to the commanded heading; else follows the commanded yaw rate.
    """

    def __init__(self, *, heading_input: bool = True, limits: TwinLimits | None = None) -> None:
        self.commands = 0  # valid velocity lines
        self.errors = 0  # lines that were not valid, and gaps in seq
        self.expiries = 0  # times the watchdog has stopped the wheels
        self.watchdog_ms = 500
        self.watchdog_expired = False
        self.fault = 0
        self.battery_v = 12.0
        self.pose: Pose = (0.0, 0.0, 0.0)  # in the world; the controller's heading counts from where it was armed
        self.velocity_mps = 0.0
        self.yaw_rate_radps = 0.0
        self.last_command: VelocityCommand | None = None
        self._heading_input = heading_input
        self._limits = limits or TwinLimits()
        self._drive = stop_command(0)
        self._zero_rad = 0.0  # world heading the controller calls 0
        self._silence_s = 0.0
        self._next_seq: int | None = None

    def handle(self, line: bytes) -> bytes | None:
        """The answer to a line, None where it gets none."""
        try:
            message = decode(line)
        except ProtocolError:
            message = None
        match message:
            case Velocity(seq, command):
                return self._obey(seq, command)
            case SetWatchdog(watchdog_ms):
                return self._arm(watchdog_ms)
        self.errors += 1
        return None

    def advance(self, dt_s: float) -> None:
        """Lets the time dt_s pass in small steps: watchdog, wheels, pose."""
        if not 0.0 <= dt_s <= LONGEST_ADVANCE_S:
            raise DriverError(f"the twin cannot advance by {dt_s} s; give 0 to {LONGEST_ADVANCE_S:g} s")
        steps = math.ceil(dt_s / STEP_S)
        for _ in range(steps):
            self._step(dt_s / steps)

    def _obey(self, seq: int, command: VelocityCommand) -> bytes:
        self.errors += self._next_seq not in (None, seq)
        self._next_seq = (seq + 1) % SEQ_COUNT
        self.commands += 1
        self.last_command = self._drive = command
        answer = encode(Status(seq, self._status()))
        self._feed_watchdog()
        return answer

    def _arm(self, watchdog_ms: int) -> bytes:
        """Connects a host: stands still, takes the present heading as zero, and any seq as the first."""
        self.watchdog_ms = watchdog_ms
        self._next_seq = None
        self._drive = stop_command(0)
        self._zero_rad = self.pose[2]
        self._feed_watchdog()
        return encode(WatchdogSet(watchdog_ms))

    def _feed_watchdog(self) -> None:
        self._silence_s, self.watchdog_expired = 0.0, False

    def _status(self) -> MotorStatus:
        return MotorStatus(
            self.velocity_mps, self._heading(), self.yaw_rate_radps, self.watchdog_expired, self.fault, self.battery_v
        )

    def _heading(self) -> float:
        return _wrap(self.pose[2] - self._zero_rad)

    def _step(self, dt_s: float) -> None:
        self._silence_s += dt_s
        if self._silence_s * 1000 > self.watchdog_ms and not self.watchdog_expired:
            self.watchdog_expired, self._drive = True, stop_command(0)
            self.expiries += 1
        reach = self._limits.acceleration_mps2 * dt_s
        self.velocity_mps += _clamp(self._drive.velocity_mps - self.velocity_mps, reach)
        reach = self._limits.yaw_acceleration_radps2 * dt_s
        self.yaw_rate_radps += _clamp(self._wanted_yaw_rate() - self.yaw_rate_radps, reach)
        self._roll(dt_s)

    def _wanted_yaw_rate(self) -> float:
        if is_stop(self._drive):
            return 0.0
        rate_radps = self._drive.yaw_rate_radps
        if self._heading_input:
            rate_radps = self._limits.heading_gain_hz * _wrap(self._drive.heading_rad - self._heading())
        return _clamp(rate_radps, self._limits.yaw_rate_radps)

    def _roll(self, dt_s: float) -> None:
        """Moves the pose along the chord of the arc."""
        x_m, y_m, heading_rad = self.pose
        turn_rad = self.yaw_rate_radps * dt_s
        chord_rad, way_m = heading_rad + turn_rad / 2, self.velocity_mps * dt_s
        self.pose = (
            x_m + way_m * math.cos(chord_rad),
            y_m + way_m * math.sin(chord_rad),
            _wrap(heading_rad + turn_rad),
        )


def _clamp(value: float, magnitude: float) -> float:
    return max(-magnitude, min(magnitude, value))


def _wrap(angle_rad: float) -> float:
    return math.remainder(angle_rad, math.tau)


class SimulatedMotor:
    """A TwinState at the other end of a pty, in real time; its thread is the foreign device's own processor."""

    def __init__(self, state: TwinState | None = None) -> None:
        """Opens the pty; `port` is what a driver opens."""
        self.state = state or TwinState()
        self.unsent = 0  # answers dropped because nobody read
        self._assembler = LineAssembler()
        self._device, self._host = os.openpty()
        tty.setraw(self._host)  # and kept open: without an open host side the device side reads errors
        os.set_blocking(self._device, False)
        self.port = os.ttyname(self._host)
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="simulated-motor", daemon=True)
        self._thread.start()

    @property
    def commands(self) -> int:
        """Valid velocity lines so far."""
        return self.state.commands

    @property
    def errors(self) -> int:
        """Invalid lines, gaps in seq and stray bytes so far."""
        return self.state.errors + self._assembler.garbage

    @property
    def pose(self) -> Pose:
        """x [m], y [m], heading [rad] of the base now."""
        return self.state.pose

    @property
    def watchdog_expired(self) -> bool:
        """Whether the wheels stand because no command came."""
        return self.state.watchdog_expired

    @property
    def last_command(self) -> VelocityCommand | None:
        """The newest valid command, with stamp 0."""
        return self.state.last_command

    def close(self) -> None:
        """Ends the thread and the pty; a second call does nothing."""
        if not self._thread.is_alive():
            return
        os.write(self._wake_write, b"x")
        self._thread.join()
        for descriptor in (self._device, self._host, self._wake_read, self._wake_write):
            os.close(descriptor)

    def _serve(self) -> None:
        last_s = time.monotonic()
        while True:
            readable, _, _ = select.select([self._device, self._wake_read], [], [], STEP_S)
            now_s = time.monotonic()
            self.state.advance(min(now_s - last_s, LONGEST_ADVANCE_S))
            last_s = now_s
            if self._wake_read in readable:
                return
            if readable:
                self._answer(os.read(self._device, READ_LIMIT_BYTES))

    def _answer(self, data: bytes) -> None:
        for line in self._assembler.feed(data):
            reply = self.state.handle(line)
            if reply is not None:
                self._send(reply)

    def _send(self, reply: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            if os.write(self._device, reply) == len(reply):
                return
        self.unsent += 1
