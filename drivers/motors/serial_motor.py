"""Driver of a motor controller on a serial port, for any protocol; the protocols by name (motor.protocol).

Another package adds a protocol by an entry point, whose name is the protocol's:

    [project.entry-points."omnid.motor_protocols"]
    sabertooth = "my_package:Sabertooth"

The object is called with a DifferentialDrive and returns a MotorProtocol.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import math
import os
import termios
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from enum import Enum, auto
from importlib.metadata import entry_points
from typing import Final, TypeAlias

import serial  # type: ignore[import-untyped]

from drivers.backoff import Backoff
from drivers.errors import DriverError, one_line
from drivers.motor import MotorStatus, VelocityCommand, is_stop, stop_command
from drivers.motors.protocols.line_protocol import LineProtocol
from drivers.motors.protocols.motor_protocol import DifferentialDrive, MotorProtocol, NoReplyError, T, Transaction
from drivers.motors.protocols.odrive_ascii import ODriveAscii
from drivers.motors.protocols.roboteq import Roboteq
from drivers.motors.protocols.vesc import Vesc

SET_UP_S: Final = 0.2  # time for the answer to the setting-up: an ODrive needs 0.1 s
POLL_PERIOD_S: Final = 0.001  # Received bytes are read with this period while an answer is awaited.
_BUSY: Final = "it is in use by another program; see `fuser -v` with its name"
_REASONS: Final = {
    errno.ENOENT: "there is no such port; plug it in, or choose one of `ls /dev/serial/by-id/*`",
    errno.EACCES: "no permission; add the user to group dialout: `sudo usermod -aG dialout $USER`, and log in again",
    errno.EBUSY: _BUSY,
    errno.EAGAIN: _BUSY,
}


class LateReplyError(NoReplyError):
    """No reply before the timeout, but the last one is so recent that the controller's watchdog cannot have expired."""


class _State(Enum):
    """What the next call of `send` does, and the state after an answer.

    | state      | next command                     | answer                                 |
    |------------|----------------------------------|----------------------------------------|
    | GONE       | open the port, then SETTING_UP   |                                        |
    | SETTING_UP | set the watchdog, then STOP_FIRST|                                        |
    | STOP_FIRST | a stop in its place              | DRIVING; STOP_FIRST where it expired   |
    | SILENT     | a stop in its place              | SETTING_UP: it may have lost its power |
    | DRIVING    | the command                      | DRIVING; STOP_FIRST where it expired   |

    No answer, or a pause in which the watchdog may expire: SILENT. A rejected command: STOP_FIRST. A lost port: GONE.
    """

    GONE = auto()
    SETTING_UP = auto()
    STOP_FIRST = auto()
    SILENT = auto()
    DRIVING = auto()


class SerialMotor:
    """The base on a serial port, locked for this program.

    `send` blocks for at most timeout_s, as long again (SET_UP_S at least) where the controller is set up, plus the
    time to open the port where it was gone; `close` for twice timeout_s. A command is sent once and never repeated: the
    caller sends the next one at its own rate.

    After LateReplyError the next command drives as usual. After any other error, a pause in which the controller's
    watchdog may have expired, or a new connection, `send` sends a stop in place of the first command and returns a
    status with watchdog_expired; the command after it drives. After a missing reply and a pause the controller is
    set up again once a stop has got a reply, because it may have been switched off and on, and another stop
    follows. A port that is gone is opened, and a controller without an answer is set up by a later `send`, with growing
    waits, during which `send` fails at once. A port that is there stays open: some boards start again when their port
    is opened, and boot for seconds.
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
        """Open the port and set the controller's watchdog; raise DriverError where either fails.

        protocol: default is the line protocol. baud: 0 is the protocol's default. connect_s: time for the first reply;
        0: it is not waited for, `send` opens the port and asks.
        """
        self.errors = 0  # calls of `send` that failed
        self.replaced_by_stop = 0  # commands in place of which a stop was sent
        self.connections = 0  # times that the controller was set up
        self._protocol = protocol or LineProtocol(DifferentialDrive())
        self._framer = self._protocol.framer()
        self._name, self._baud = port, baud or self._protocol.baud
        self._timeout_s, self._watchdog_ms = timeout_s, watchdog_ms
        self._port: serial.Serial | None = None
        self._closed = False
        self._state = _State.GONE
        self._last_sent_s = -math.inf  # start of the last command that got a reply, by _clock_s
        self._fresh_s = 0.0  # for this long after it, the watchdog cannot have expired
        self._waits, self._next_try_s = Backoff(), -math.inf
        self._problem = ""  # why the last try failed
        next(self._protocol.connect(watchdog_ms))  # what no controller can be asked for is an error at once
        if connect_s:
            try:
                self._connect(time.monotonic() + connect_s)
            except BaseException:
                self._release()
                raise

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Send a command and return the controller's status.

        Raises LateReplyError or NoReplyError at the timeout, DriverError where the port is gone or the command is
        rejected.
        """
        before = self._state
        try:
            if before in (_State.GONE, _State.SETTING_UP):
                self._try_again()
            return self._send(command)
        except DriverError as error:
            self.errors += 1
            is_silent = isinstance(error, NoReplyError)
            if is_silent and self._state is _State.DRIVING and _clock_s() - self._last_sent_s <= self._fresh_s:
                raise LateReplyError(str(error)) from None  # the controller's watchdog cannot have expired by now
            if self._state in (_State.STOP_FIRST, _State.DRIVING):
                was_set_up = before not in (_State.GONE, _State.SETTING_UP)
                self._state = _State.SILENT if is_silent and was_set_up else _State.STOP_FIRST
            raise

    def close(self) -> None:
        """Stop the wheels if the controller replies, and release the port; a second call does nothing."""
        self._closed = True
        with contextlib.suppress(DriverError):
            for _ in range(2 if self._port is not None else 0):  # a second try where the first gets no reply
                with contextlib.suppress(NoReplyError):
                    self._run(self._protocol.drive(stop_command(0)), self._timeout_s)
                    break
        self._release()

    def _connect(self, deadline_s: float) -> None:
        """Open the port and send stops until one gets a reply; raise DriverError after the deadline."""
        while self._state is not _State.DRIVING:
            is_over = time.monotonic() >= deadline_s
            try:
                if self._state in (_State.GONE, _State.SETTING_UP):
                    self._set_up()
                self._send(stop_command(0))
            except NoReplyError:
                if is_over:
                    raise
            if is_over:  # a controller whose watchdog stays expired says so in each status
                return

    def _try_again(self) -> None:
        """Set up the controller, unless the last try failed just now; raise DriverError then, and where it fails."""
        if self._closed:
            raise DriverError(f"motor on {self._name} is closed; make a new one")
        if time.monotonic() < self._next_try_s:
            raise DriverError(self._problem)
        try:
            self._set_up()
        except DriverError as error:
            self._problem, self._next_try_s = str(error), time.monotonic() + self._waits.next_s()
            raise
        self._waits.reset()

    def _set_up(self) -> None:
        """Open the port if it is gone, and set the controller's watchdog."""
        if self._state is _State.GONE:
            self._port, self._state = _opened(self._name, self._baud), _State.SETTING_UP
        in_force_ms = self._run(self._protocol.connect(self._watchdog_ms), max(SET_UP_S, self._timeout_s))
        # After a pause of half of the watchdog's time it may expire before a command arrives.
        self._fresh_s = in_force_ms / 1000 / 2
        self._state = _State.STOP_FIRST
        self.connections += 1

    def _send(self, command: VelocityCommand) -> MotorStatus:
        # 1. Send the command, or a stop in its place.
        now_s = _clock_s()
        if self._state is _State.DRIVING and now_s - self._last_sent_s > self._fresh_s:
            self._state = _State.SILENT
        stopping = self._state is not _State.DRIVING
        sent = stop_command(command.stamp_ns) if stopping else command
        status = self._run(self._protocol.drive(sent), self._timeout_s)
        # 2. What the answer says of the next command.
        self._last_sent_s = now_s
        if self._state is _State.SILENT:
            self._state = _State.SETTING_UP
        else:
            self._state = _State.STOP_FIRST if status.watchdog_expired else _State.DRIVING
        if is_stop(command) or not stopping:
            return status
        self.replaced_by_stop += 1
        return replace(status, watchdog_expired=True)

    def _release(self) -> None:
        port, self._port, self._state = self._port, None, _State.GONE
        if port is not None:
            with contextlib.suppress(OSError, termios.error):
                fcntl.ioctl(port.fileno(), termios.TIOCNXCL)
            with contextlib.suppress(OSError, termios.error):
                port.close()

    def _run(self, transaction: Transaction[T], timeout_s: float) -> T:
        """Discard replies to earlier commands, run a transaction, and return its result; NoReplyError after timeout_s.

        The input is read once more after that, since a thread that was delayed may find a reply waiting that came in
        time.
        """
        deadline_s = time.monotonic() + timeout_s
        self._framer.reset()
        try:
            with self._on_port():
                if self._port is not None:
                    self._port.reset_input_buffer()
                self._write(next(transaction))
                overdue = False
                while not overdue:
                    overdue = time.monotonic() >= deadline_s
                    for frame in self._framer.feed(self._read(deadline_s)):
                        self._write(transaction.send(frame))
                advice = f"check power, cable, the baud rate ({self._baud}, motor.baud) and motor.protocol"
                raise NoReplyError(f"gave no answer of its protocol; {advice}")
        except StopIteration as done:
            result: T = done.value
            return result

    @contextlib.contextmanager
    def _on_port(self) -> Iterator[None]:
        """Name the port in the errors of this block; a port that fails is released."""
        try:
            yield
        except NoReplyError as error:
            raise NoReplyError(f"motor on {self._name} {error}") from None
        except DriverError as error:
            raise DriverError(f"motor on {self._name}: {error}") from None
        except (OSError, termios.error) as error:
            self._release()
            raise DriverError(f"motor on {self._name} is gone ({one_line(error)}); plug it in again") from None

    def _write(self, data: bytes) -> None:
        """Write all data at once; raise NoReplyError if the output buffer is full, as the other end does not read."""
        if data and self._port is not None:
            with contextlib.suppress(BlockingIOError):
                if os.write(self._port.fileno(), data) == len(data):
                    return
            raise NoReplyError("gave no answer: it takes no more bytes; check power and cable")

    def _read(self, deadline_s: float) -> bytes:
        """Return the bytes received up to now, or the first ones before the deadline, b"" without any.

        Polls, since select and a blocking read on a terminal wait for a kernel thread without priority: on a busy
        machine that takes far longer than any timeout.
        """
        if self._port is None:
            raise NoReplyError("gave no answer: the port is closed")
        while not (waiting := self._port.in_waiting):
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                return b""
            time.sleep(min(left_s, POLL_PERIOD_S))
        return os.read(self._port.fileno(), waiting)


def _opened(port: str, baud: int) -> serial.Serial:
    """Open the port for exclusive, non-blocking use; raise DriverError where it cannot be opened.

    pyserial's exclusive=True is flock(2), which only programs that lock as well respect. TIOCEXCL (ioctl_tty(2)) makes
    the kernel refuse every further open(2) with EBUSY, except of a process with CAP_SYS_ADMIN. A program that is killed
    leaves the mode only on a pseudo terminal whose other end stays open.
    """
    opened: serial.Serial | None = None
    try:
        opened = serial.Serial(port, baud, timeout=0, exclusive=True)
        fcntl.ioctl(opened.fileno(), termios.TIOCEXCL)
        return opened
    except (OSError, ValueError, termios.error) as error:
        if opened is not None:
            opened.close()
        reason = _REASONS.get(getattr(error, "errno", None) or 0)
        raise DriverError(
            f"motor port {port!r} at {baud} baud cannot be opened: "
            f"{reason or one_line(error) + '; is it a serial port?'}"
        ) from None


def _clock_s() -> float:
    """Return the time with that in which the host was suspended: a controller's watchdog expires meanwhile."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


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
