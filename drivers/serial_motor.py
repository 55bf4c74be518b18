"""A motor controller behind a serial port, speaking the line protocol."""

from __future__ import annotations

import contextlib
import math
import termios
import time
from collections.abc import Iterator

import serial  # type: ignore[import-untyped]

from drivers.errors import DriverError
from drivers.line_protocol import (
    SEQ_COUNT,
    LineAssembler,
    Message,
    ProtocolError,
    SetWatchdog,
    Status,
    Velocity,
    WatchdogSet,
    decode,
    encode,
)
from drivers.motor import MotorStatus, VelocityCommand, stop_command

TRIES = 3
STOPS_AT_CLOSE = 3
READ_LIMIT_BYTES = 4096


class SerialMotor:
    """The base on `port`; one answer is waited for about timeout_s, and asked for at most TRIES times."""

    def __init__(
        self, port: str, baud: int = 115200, timeout_s: float = 0.05, watchdog_ms: int = 500, *, connect_s: float = 3.0
    ) -> None:
        """Opens the port and has the controller stop by itself after watchdog_ms; DriverError where it does not.

        connect_s: some boards restart when their port is opened and stay silent for seconds.
        """
        if not (math.isfinite(timeout_s) and timeout_s > 0):
            raise DriverError(f"motor timeout is {timeout_s} s; give a time above 0, for example 0.05")
        setting = encode(SetWatchdog(watchdog_ms))
        self.bad_lines = 0  # whole lines that were not of the protocol
        self._name, self._timeout_s = port, timeout_s
        self._assembler = LineAssembler()
        self._seq = 0
        self._port = _open(port, baud, timeout_s)
        try:
            self._verify(watchdog_ms, self._arm(setting, connect_s))
        except BaseException:
            self._port.close()
            raise

    @property
    def garbage(self) -> int:
        """Bytes received that belonged to no whole line."""
        return self._assembler.garbage

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Hands the command over and gives the controller's answer; DriverError when it stays silent or is gone."""
        for _ in range(TRIES):
            status = self._try(command)
            if status is not None:
                return status
        raise DriverError(
            f"motor on {self._name} gave no answer to {TRIES} commands, {self._timeout_s} s each; check power and cable"
        )

    def close(self) -> None:
        """Stops the wheels as well as it can and releases the port; a second call does nothing."""
        if not self._port.is_open:
            return
        with contextlib.suppress(DriverError):
            for _ in range(STOPS_AT_CLOSE):
                self._try(stop_command(0))
        with contextlib.suppress(OSError):
            self._port.close()

    def _try(self, command: VelocityCommand) -> MotorStatus | None:
        """One line out and the status with its seq back; None when its time is over."""
        line = encode(Velocity(self._seq, command))
        seq, self._seq = self._seq, (self._seq + 1) % SEQ_COUNT
        for answer in self._answers(line):
            if isinstance(answer, Status) and answer.seq == seq:
                return answer.status
        return None

    def _arm(self, setting: bytes, connect_s: float) -> int:
        """Sets the watchdog and gives the time the controller says is in force [ms]."""
        deadline = time.monotonic() + connect_s
        while time.monotonic() < deadline:
            for answer in self._answers(setting):
                if isinstance(answer, WatchdogSet):
                    return answer.watchdog_ms
        raise DriverError(
            f"motor on {self._name} confirmed no watchdog within {connect_s} s; check power, cable and baud rate"
        )

    def _verify(self, asked_ms: int, in_force_ms: int) -> None:
        if in_force_ms != asked_ms:
            raise DriverError(
                f"motor on {self._name}: watchdog of {asked_ms} ms asked, {in_force_ms} ms in force; ask for another"
            )

    def _answers(self, line: bytes) -> Iterator[Message]:
        """Writes a line and yields what comes back until timeout_s is over."""
        deadline = time.monotonic() + self._timeout_s
        self._write(line)
        while time.monotonic() < deadline:
            for answer in self._assembler.feed(self._read()):
                try:
                    yield decode(answer)
                except ProtocolError:
                    self.bad_lines += 1

    def _write(self, line: bytes) -> None:
        try:
            self._port.write(line)
        except OSError as error:
            raise self._lost(error) from error

    def _read(self) -> bytes:
        """What has arrived, or the first byte that arrives within timeout_s."""
        try:
            return bytes(self._port.read(max(1, min(self._port.in_waiting, READ_LIMIT_BYTES))))
        except OSError as error:
            raise self._lost(error) from error

    def _lost(self, error: OSError) -> DriverError:
        return DriverError(f"motor on {self._name} is gone ({error}); plug it in again and restart")


def _open(port: str, baud: int, timeout_s: float) -> serial.Serial:
    """The port, for this program alone."""
    try:
        return serial.Serial(port, baud, timeout=timeout_s, write_timeout=timeout_s, exclusive=True)
    except (OSError, ValueError, termios.error) as error:
        raise DriverError(
            f"motor port {port} at {baud} baud cannot be opened ({error}); "
            "check the name, that nothing else uses it, and that the user is in group dialout"
        ) from error
