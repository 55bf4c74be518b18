"""A motor controller behind a serial port, whatever its protocol."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import termios
import time
from dataclasses import replace

import serial  # type: ignore[import-untyped]

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand, is_stop, stop_command
from drivers.motors.differential_drive import DifferentialDrive
from drivers.motors.motor_protocol import MotorProtocol, T, Transaction
from drivers.motors.protocols.line_protocol import LineProtocol

CONNECT_TRY_S = 0.2
STOPS_AT_CLOSE = 3
READ_LIMIT_BYTES = 4096
LOOK_S = 0.001  # between two looks at whether an answer has come
STALE_SHARE = 0.5  # of the watchdog's time: later than that the controller may have stopped before a command arrives
FIRST_WAIT_S = 0.2
LONGEST_WAIT_S = 5.0
_REASONS = {
    errno.ENOENT: "there is no such port; plug it in, or choose one of `ls /dev/serial/by-id/*`",
    errno.EACCES: "no permission; add the user to group dialout: `sudo usermod -aG dialout $USER`, and log in again",
    errno.EBUSY: "it is in use by another program; see `fuser -v` with its name",
    errno.EAGAIN: "it is in use by another program; see `fuser -v` with its name",
}


class NoReplyError(DriverError):
    """No answer within the time; the port is still there."""


class LateReplyError(NoReplyError):
    """No answer within the time, but the last one is so young that the controller's watchdog cannot have expired."""


class SerialMotor:
    """The base on `port`, for this program alone.

    `send` blocks for at most timeout_s, and for the opening of the port where that was gone; `close` for STOPS_AT_CLOSE
    times that. A command is told once: who sends at a rate sends the next one anyway. An answer that is Late does no
    harm. After any other error, a silence in which the controller's watchdog may have expired, or a new connection, the
    first thing told is an explicit stop, whatever was asked: the status then says watchdog_expired, and the next
    command drives. A port that is gone is opened again by a later `send`, with growing waits in between, in which
    `send` fails at once.
    """

    def __init__(
        self,
        port: str,
        protocol: MotorProtocol | None = None,
        *,
        baud: int = 0,
        timeout_s: float = 0.1,
        watchdog_ms: int = 500,
        connect_s: float = 3.0,
    ) -> None:
        """Opens the port and has the controller stop by itself after watchdog_ms; DriverError where it does not.

        protocol: the line protocol where none is given. baud: 0 is the protocol's own.
        connect_s: some boards restart when their port is opened and stay silent for seconds.
        """
        if not (math.isfinite(timeout_s) and timeout_s > 0):
            raise DriverError(f"motor timeout is {timeout_s} s; give a time above 0, for example 0.05")
        self.errors = 0  # calls of `send` that failed
        self.replaced_by_stop = 0  # commands in place of which a stop was told
        self.connections = 0
        self._protocol = protocol or LineProtocol(DifferentialDrive())
        self._framer = self._protocol.framer()
        self._name, self._baud = port, baud or self._protocol.baud
        self._timeout_s, self._watchdog_ms = timeout_s, watchdog_ms
        self._port: serial.Serial | None = None
        self._closed = self._armed = False
        self._stop_first = True
        self._heard_s = -math.inf  # when the last command that was answered had been begun
        self._patience_s = 0.0  # silence in which the watchdog cannot have expired
        self._wait_s, self._next_open_s = FIRST_WAIT_S, -math.inf
        self._connect(connect_s)

    @property
    def garbage(self) -> int:
        """Bytes received that belonged to no whole frame."""
        return self._framer.garbage

    @property
    def bad_frames(self) -> int:
        """Frames received that made no sense."""
        return self._protocol.bad_frames

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Hands the command over and gives the controller's answer; DriverError when it stays silent or is gone."""
        try:
            return self._sent(command, time.monotonic() + self._timeout_s)
        except DriverError as error:
            self.errors += 1
            if isinstance(error, NoReplyError) and self._surely_drives():
                raise LateReplyError(str(error)) from None
            self._stop_first = True
            raise

    def _surely_drives(self) -> bool:
        """Whether the controller cannot have stopped by itself by now."""
        return self._armed and not self._stop_first and time.monotonic() - self._heard_s <= self._patience_s

    def close(self) -> None:
        """Stops the wheels as well as it can and releases the port; a second call does nothing."""
        self._closed = True
        with contextlib.suppress(DriverError):
            for _ in range(STOPS_AT_CLOSE):
                if self._port is None or self._stopped():
                    break
        self._release()

    def _sent(self, command: VelocityCommand, deadline_s: float) -> MotorStatus:
        if self._port is None:
            self._open()
        if not self._armed:
            self._arm(deadline_s)
        now_s = time.monotonic()
        stopping = self._stop_first or now_s - self._heard_s > self._patience_s
        told = stop_command(command.stamp_ns) if stopping else command
        status = self._run(self._protocol.drive(told, now_s), deadline_s)
        self._heard_s = now_s
        self._stop_first = status.watchdog_expired
        if is_stop(command) or not stopping:
            return status
        self.replaced_by_stop += 1
        return replace(status, watchdog_expired=True)

    def _connect(self, connect_s: float) -> None:
        """The first connection may take its time: nothing moves yet."""
        deadline_s = time.monotonic() + connect_s
        self._open()
        try:
            while self._stop_first:
                self._try_to_stop(deadline_s)
        except BaseException:
            self._release()
            raise

    def _try_to_stop(self, deadline_s: float) -> None:
        """Silence is borne until the deadline; the last try may go on past it."""
        try:
            self._sent(stop_command(0), time.monotonic() + max(CONNECT_TRY_S, self._timeout_s))
        except NoReplyError:
            if time.monotonic() >= deadline_s:
                raise
            return
        if self._stop_first and time.monotonic() >= deadline_s:
            raise DriverError(f"motor on {self._name} stays stopped by its watchdog; switch it off and on again")

    def _arm(self, deadline_s: float) -> None:
        self._stop_first = True
        in_force_ms = self._run(self._protocol.connect(self._watchdog_ms), deadline_s)
        self._patience_s = STALE_SHARE * in_force_ms / 1000
        self._armed, self._wait_s = True, FIRST_WAIT_S
        self.connections += 1

    def _stopped(self) -> bool:
        with contextlib.suppress(NoReplyError):
            self._run(self._protocol.drive(stop_command(0), time.monotonic()), time.monotonic() + self._timeout_s)
            return True
        return False

    def _open(self) -> None:
        """DriverError where it is not yet time to try again, or the port cannot be had."""
        if self._closed:
            raise DriverError(f"motor on {self._name} is closed; make a new one")
        wait_s = self._next_open_s - time.monotonic()
        if wait_s > 0:
            raise DriverError(f"motor on {self._name} is gone; plug it in, it is tried again in {wait_s:.1f} s")
        self._next_open_s = time.monotonic() + self._wait_s
        self._wait_s = min(2 * self._wait_s, LONGEST_WAIT_S)
        self._port = _opened(self._name, self._baud)

    def _release(self) -> None:
        port, self._port, self._armed = self._port, None, False
        if port is not None:
            with contextlib.suppress(OSError, termios.error):
                port.close()

    def _run(self, transaction: Transaction[T], deadline_s: float) -> T:
        """What a script returns; Silence at the deadline, after a last look at what a late thread finds waiting."""
        request = self._framer.garbage + self._protocol.bad_frames
        try:
            self._forget_input()
            self._write(next(transaction))
            overdue = False
            while not overdue:
                overdue = time.monotonic() >= deadline_s
                for frame in self._framer.feed(self._read(deadline_s)):
                    self._write(transaction.send(frame))
            raise NoReplyError
        except StopIteration as done:
            result: T = done.value
            return result
        except NoReplyError:
            raise self._silence(self._framer.garbage + self._protocol.bad_frames - request) from None
        except DriverError as error:
            raise DriverError(f"motor on {self._name}: {error}") from None
        except (OSError, termios.error) as error:
            self._release()
            raise DriverError(f"motor on {self._name} is gone ({_line(error)}); plug it in again") from None

    def _forget_input(self) -> None:
        """Answers to earlier commands are nobody's."""
        self._framer.reset()
        if self._port is not None:
            self._port.reset_input_buffer()

    def _write(self, data: bytes) -> None:
        """All of it at once, or none of it counts: a port that takes no more has nobody who reads."""
        if data and self._port is not None:
            try:
                if os.write(self._port.fileno(), data) < len(data):
                    raise NoReplyError
            except BlockingIOError:
                raise NoReplyError from None

    def _read(self, deadline_s: float) -> bytes:
        """What has arrived, or arrives until the deadline.

        It is looked for again and again: whoever waits for a terminal, by select or a read, waits for a thread of the
        kernel that has no priority, on a busy machine far beyond any timeout.
        """
        if self._port is None:
            raise NoReplyError
        while not self._port.in_waiting:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                return b""
            time.sleep(min(left_s, LOOK_S))
        return os.read(self._port.fileno(), READ_LIMIT_BYTES)

    def _silence(self, nonsense: int) -> NoReplyError:
        if nonsense:
            return NoReplyError(
                f"motor on {self._name} answers, but not in its protocol; check motor.protocol, the baud rate "
                f"({self._baud}) and the cable"
            )
        return NoReplyError(
            f"motor on {self._name} gave no answer; check power, cable, the baud rate ({self._baud}) and motor.protocol"
        )


def _opened(port: str, baud: int) -> serial.Serial:
    """The port, for this program alone; reads and writes do not wait."""
    try:
        return serial.Serial(port, baud, timeout=0, exclusive=True)
    except (OSError, ValueError, termios.error) as error:
        reason = _REASONS.get(getattr(error, "errno", None) or 0)
        raise DriverError(
            f"motor port {port!r} at {baud} baud cannot be opened: {reason or _line(error) + '; is it a serial port?'}"
        ) from None


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
