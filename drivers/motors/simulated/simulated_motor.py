"""A simulated controller at the other end of a real pty: the twin of a base, for demonstrations and tests."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from typing import Protocol

from drivers.motor import VelocityCommand
from drivers.motors.simulated.simulated_base import STEP_S, Pose, SimulatedBase
from drivers.motors.simulated.simulated_line import SimulatedLine

READ_LIMIT_BYTES = 4096
LONGEST_ABSENCE_S = 0.05  # a twin that got no processor for longer stands still with its clocks: nobody was silent


class SimulatedController(Protocol):
    """The firmware of a twin: bytes in, bytes out, wheels turned. It checks every byte and counts what is wrong."""

    @property
    def base(self) -> SimulatedBase:
        """Its wheels."""

    def feed(self, data: bytes) -> bytes:
        """The answers to what has arrived."""


class SimulatedMotor:
    """A controller on a pty, in real time; its thread is the foreign device's own processor.

    silent: it hears and obeys, but answers nothing. deaf: it does neither. garbage: what comes before each answer.
    """

    def __init__(self, controller: SimulatedController | None = None) -> None:
        """Opens the pty; `port` is what a driver opens."""
        self.controller = controller or SimulatedLine()
        self.unsent = 0  # answers dropped because nobody read
        self.drop_replies = self.drop_input = False
        self.garbage = b""
        self._device, self._host = os.openpty()
        tty.setraw(self._host)  # and kept open: without an open host side the device side reads errors
        os.set_blocking(self._device, False)
        self.port = os.ttyname(self._host)
        self._expiring = threading.Event()
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="simulated-motor", daemon=True)
        self._thread.start()

    @property
    def base(self) -> SimulatedBase:
        """The base."""
        return self.controller.base

    @property
    def commands(self) -> int:
        """Valid commands so far."""
        return self.base.commands

    @property
    def errors(self) -> int:
        """What was wrong so far: bytes, numbers, order."""
        return self.base.errors

    @property
    def pose(self) -> Pose:
        """x [m], y [m], heading [rad] of the base now."""
        return self.base.pose

    @property
    def watchdog_expired(self) -> bool:
        """Whether the wheels stand because no command came."""
        return self.base.watchdog_expired

    @property
    def last_command(self) -> VelocityCommand:
        """The motion that was told last, with stamp 0."""
        return self.base.last_command

    def expire(self) -> None:
        """Has the watchdog stop the wheels at once."""
        self._expiring.set()
        while self._expiring.is_set() and self._thread.is_alive():
            time.sleep(STEP_S)

    def send(self, data: bytes) -> None:
        """Sends bytes, asked or not; drops them where nobody reads."""
        with contextlib.suppress(BlockingIOError):
            if os.write(self._device, data) == len(data):
                return
        self.unsent += 1

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
            self.base.advance(min(now_s - last_s, LONGEST_ABSENCE_S))
            last_s = now_s
            if self._wake_read in readable:
                return
            if self._expiring.is_set():
                self.base.expire()
                self._expiring.clear()
            if readable:
                self._receive(os.read(self._device, READ_LIMIT_BYTES))

    def _receive(self, data: bytes) -> None:
        if self.drop_input:
            return
        answer = self.controller.feed(data)
        if answer and not self.drop_replies:
            self.send(self.garbage + answer)
