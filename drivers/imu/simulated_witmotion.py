"""A simulated IMU of WitMotion on a pseudo-terminal, for demonstrations and tests."""

from __future__ import annotations

import contextlib
import os
import threading
import time
import tty
from collections.abc import Callable

from drivers.imu.witmotion import GYRO, PACKET, RADPS_PER_UNIT, START

LARGEST_UNITS = 32767


def gyro_packet(rates_radps: tuple[float, float, float]) -> bytes:
    """Return the packet of angular velocities about x, y, z; beyond the range of the device it is the largest one."""
    units = (max(-LARGEST_UNITS, min(LARGEST_UNITS, round(rate / RADPS_PER_UNIT))) for rate in rates_radps)
    packet = PACKET.pack(START, GYRO, *units, 0, 0)
    return packet[:-1] + bytes([sum(packet[:-1]) & 0xFF])


class SimulatedWitMotion:
    """Sends measurements at a rate in real time, whether they are read or not."""

    def __init__(self, rates_radps: Callable[[], tuple[float, float, float]], rate_hz: float) -> None:
        """Open the pty; `port` is the path for the driver. rates_radps: called for each measurement."""
        self._rates, self._period_s = rates_radps, 1.0 / rate_hz
        self.unsent = 0  # packets dropped because the host did not read
        self._device, self._host = os.openpty()
        tty.setraw(self._host)  # kept open: without an open host side, writes to the device side fill up
        os.set_blocking(self._device, False)
        self.port = os.ttyname(self._host)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._send, name="simulated-imu", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and close the pty; a second call does nothing."""
        if not self._thread.is_alive():
            return
        self._closing.set()
        self._thread.join()
        os.close(self._device)
        os.close(self._host)

    def _send(self) -> None:
        due_s = time.monotonic()
        while not self._closing.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + self._period_s, time.monotonic())  # late ones are left out
            with contextlib.suppress(BlockingIOError):
                if os.write(self._device, gyro_packet(self._rates())) == PACKET.size:
                    continue
            self.unsent += 1
