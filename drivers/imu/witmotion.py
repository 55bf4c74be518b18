"""Gyro of WitMotion's serial IMUs (WT61, WT901 and others), which send their measurements unasked.

Their protocol: packets of 11 bytes, 0x55, a type, four numbers of 16 bits (little endian), and the sum of the ten bytes
before. Type 0x52 holds angular velocities about x, y, z in units of 2000 / 32768 degrees per second.
"""

from __future__ import annotations

import errno
import math
import struct
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Final

import serial  # type: ignore[import-untyped]

from drivers.errors import DriverError
from drivers.motion import GyroSample
from drivers.pseudo_terminal import TerminalCheck

START: Final = 0x55
GYRO: Final = 0x52
PACKET: Final = struct.Struct("<BB4hB")
RADPS_PER_UNIT: Final = math.radians(2000.0) / 32768
DEFAULT_BAUD: Final = 9600
READ_S: Final = 0.1  # longest wait for bytes, so that `close` takes effect soon
PERIOD_SHARE: Final = 0.05  # Share of a read in the period of samples.
LONGEST_PERIOD_S: Final = 0.2  # slowest rate of the maker that is of use, 5 Hz
SILENT_S: Final = 2.0  # The port is opened again after this time without a packet.
# Waits between two attempts to open the port: doubled from the first to the longest.
FIRST_WAIT_S, LONGEST_WAIT_S = 0.2, 5.0
_REASONS: Final = {
    errno.ENOENT: "there is no such port; plug it in, or choose one of `ls /dev/serial/by-id/*`",
    errno.EACCES: "no permission; add the user to group dialout: `sudo usermod -aG dialout $USER`, and log in again",
}


class PacketReader:
    """Finds packets in a stream of bytes; broken counts packets whose sum is wrong."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.broken = 0

    def feed(self, data: bytes) -> Iterator[tuple[float, float, float]]:
        """Yield the angular velocities [rad/s] in the bytes."""
        self._bytes += data
        while (start := self._bytes.find(START)) >= 0 and len(self._bytes) - start >= PACKET.size:
            packet = bytes(self._bytes[start : start + PACKET.size])
            if sum(packet[:-1]) & 0xFF != packet[-1]:
                self.broken += 1
                del self._bytes[: start + 1]  # the start may have been a byte of a packet
                continue
            del self._bytes[: start + PACKET.size]
            _, kind, x, y, z, _, _ = PACKET.unpack(packet)
            if kind == GYRO:
                yield x * RADPS_PER_UNIT, y * RADPS_PER_UNIT, z * RADPS_PER_UNIT
        if start < 0:
            self._bytes.clear()


class WitMotionGyro:
    """The gyro on a serial port; its rate and baud rate are those that it was set to by its maker's program.

    The stamp of a sample is the time of its arrival (CLOCK_MONOTONIC). Where several samples arrive together, the last
    one has that stamp, and each one before it an earlier stamp by the usual period. What arrived before the first read
    is dropped, because its time is not known. A port that disappears is opened again, unless it is a pseudo-terminal
    that belongs to another program by then.
    """

    def __init__(self, port: str, baud: int = DEFAULT_BAUD, on_event: Callable[[str], None] = lambda _: None) -> None:
        """Open the port; raise DriverError where it cannot be opened. on_event: takes lines for the log."""
        self._name, self._baud, self._on_event = port, baud, on_event
        self._closed = False
        self._reader = PacketReader()
        self._terminal = TerminalCheck(port)
        self._reported = ""  # why the port could not be opened again
        self.restarts = 0
        self._port = self._opened()

    @property
    def broken(self) -> int:
        """Number of packets whose sum is wrong."""
        return self._reader.broken

    def samples(self) -> Iterator[GyroSample]:
        """Yield the samples until `close` is called."""
        self._discard()
        received_s, wait_s = time.monotonic(), FIRST_WAIT_S
        least_s = PACKET.size * 10 / self._baud  # a packet takes so long
        period_s = 0.0  # of samples, 0: not known
        while not self._closed:
            data = self._read()
            now_ns = time.monotonic_ns()
            rates = list(self._reader.feed(data))
            apart_s = 0.0
            if rates:
                # A late read brings more samples, so their mean period stays right; only after a pause it is too large.
                mean_s = min(max(least_s, (now_ns * 1e-9 - received_s) / len(rates)), LONGEST_PERIOD_S)
                period_s += (PERIOD_SHARE if period_s else 1.0) * (mean_s - period_s)
                apart_s = min(period_s, mean_s)  # so that none is earlier than those of the read before
            for k, rate in enumerate(rates):
                yield GyroSample(now_ns - round((len(rates) - 1 - k) * apart_s * 1e9), *rate)
            if rates:
                received_s, wait_s = now_ns * 1e-9, FIRST_WAIT_S
            elif time.monotonic() - received_s > SILENT_S:
                self._reopen(wait_s)
                self._discard()
                period_s = 0.0
                received_s, wait_s = time.monotonic(), min(2 * wait_s, LONGEST_WAIT_S)

    def close(self) -> None:
        """End `samples`; may be called twice, from any thread."""
        self._closed = True

    def _discard(self) -> None:
        """Drop what has arrived so far."""
        if self._port is not None:
            with suppress(serial.SerialException, OSError, termios.error):  # the next read reports it
                self._port.reset_input_buffer()

    def _read(self) -> bytes:
        if self._port is None:
            time.sleep(READ_S)
            return b""
        try:
            return bytes(self._port.read(max(1, self._port.in_waiting)))
        except (serial.SerialException, OSError) as error:
            self._on_event(f"the IMU on {self._name} is gone: {error}")
            self._port.close()
            self._port = None
            return b""

    def _reopen(self, wait_s: float) -> None:
        if self._port is not None:
            self._on_event(f"the IMU on {self._name} sends nothing that is valid; check its baud rate, {self._baud}")
            self._port.close()
        until_s = time.monotonic() + wait_s
        while not self._closed and time.monotonic() < until_s:
            time.sleep(READ_S)
        self.restarts += 1
        try:
            self._port, self._reported = self._opened(), ""
        except DriverError as error:
            self._port = None
            if str(error) != self._reported:
                self._reported = str(error)
                self._on_event(self._reported)

    def _opened(self) -> serial.Serial | None:
        self._terminal.require_same()
        try:
            return serial.Serial(self._name, self._baud, timeout=READ_S, exclusive=True)
        except (serial.SerialException, OSError, ValueError) as error:
            reason = _REASONS.get(getattr(error, "errno", None) or 0, str(error))
            raise DriverError(f"cannot open the IMU on {self._name!r}: {reason}") from error
