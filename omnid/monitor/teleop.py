"""Drive a robot by the keys of a terminal, which reports no release of a key: a motion ends when no key repeats it."""

from __future__ import annotations

import math
import os
import re
import select
import sys
import termios
import time
import tomllib
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import DEFAULT_BUFFER_SIZE
from typing import Final

from omnid.client import Diagnostics, Robot
from omnid.core.control.heading_controller import VelocityLimits
from omnid.engine.logging_setup import HANDLER
from omnid.errors import OmnidError
from omnid.transport.codec import header_cdr
from omnid.transport.session import BusConfig
from omnid.transport.status_names import WHEELS, Key
from omnid.transport.topics import ARM

PERIOD_S: Final = 0.05  # Period of the commands.
# Time for which a key counts as pressed: longer than the pause before a terminal repeats it. Zero is sent as long after
# a motion; then nothing, so that others may drive.
HOLD_S: Final = 0.6
_SIDES: Final = {b"A": "forward", b"B": "back", b"D": "left", b"C": "right"}
# A terminal sends ESC [ A or, in its application mode, ESC O A.
ARROWS: Final = {begin + letter: side for letter, side in _SIDES.items() for begin in (b"\x1b[", b"\x1bO")}
# One key: a whole escape sequence (ECMA-48, 5.4, without intermediate bytes, of which the space is one), or a byte.
_KEY: Final = re.compile(rb"\x1b(?:\[[0-?]{0,16}|O)[@-~]|.", re.DOTALL)


@dataclass
class Stick:
    """Keys as a stick: a side counts as pressed for HOLD_S after its last key."""

    limits: VelocityLimits
    share: float = 0.4  # of the highest speeds, at the start
    stop_asked: bool = False
    arm_asked: bool = False
    quit: bool = False
    _pressed_s: dict[str, float] = field(default_factory=dict)  # by side
    _moved_s: float = -math.inf  # when the last arrow was pressed

    def press(self, data: bytes, now_s: float) -> None:
        """Process the bytes of the keys pressed until now_s."""
        for key in _KEY.findall(data):
            if key in ARROWS:
                self._pressed_s[ARROWS[key]] = self._moved_s = now_s
            elif key in (b"+", b"=", b"-"):
                self.share = self.share / 2 if key == b"-" else min(1.0, 2 * self.share)
            elif key == b"a":  # Not A, the last byte of an arrow whose bytes may come in parts.
                self.arm_asked = True
            elif key in b"q\x04":
                self.quit = True
            else:  # Space, and any key without a meaning: in doubt the wheels stop.
                self.stop_asked |= key == b" "
                self._pressed_s.clear()

    def twist(self, now_s: float) -> tuple[float, float]:
        """Return forward speed [m/s] and yaw rate [rad/s]."""
        pressed = {side for side, pressed_s in self._pressed_s.items() if now_s - pressed_s <= HOLD_S}
        forward, turn = ("forward" in pressed) - ("back" in pressed), ("left" in pressed) - ("right" in pressed)
        return (self.share * forward * self.limits.velocity_mps, self.share * turn * self.limits.yaw_rate_radps)

    def is_moving(self, now_s: float) -> bool:
        """True if there is a motion, or was one less than HOLD_S ago."""
        return now_s - self._moved_s <= 2 * HOLD_S


def teleoperate(bus: BusConfig) -> int:
    """Drive the robot until `q`; return the exit code. OmnidError without a terminal, or where it cannot be reached."""
    if not sys.stdin.isatty():
        raise OmnidError("omnid drive needs a keyboard: run it in a terminal")
    with raw_keys() as keys, Robot(settings=bus) as robot, robot.subscribe(Diagnostics) as statuses:
        driver, stick = robot.driver(), Stick(limits_of(robot))
        driver.require_connected()
        print("arrows: drive  space: stop  a: arm  +/-: speed  q: quit")
        pressed_s = -math.inf  # Keys typed while it connected still stop, arm and quit, but cause no motion.
        try:
            status = ""
            while not stick.quit:
                # 1. The keys, and the newest status of the robot.
                stick.press(read_keys(keys), pressed_s)
                now_s = pressed_s = time.monotonic()
                if (report := statuses.newest()) is not None:
                    disarmed = report.value(WHEELS, Key.DISARMED_BY)
                    status = f"press a: not armed, {disarmed}" if disarmed else "armed"
                # 2. Commands. Arming is not waited for, as the next key may be a stop: the status shows the answer.
                if stick.stop_asked:
                    driver.stop()
                elif stick.arm_asked:
                    driver.send(ARM, header_cdr(time.time_ns()))
                stick.stop_asked = stick.arm_asked = False
                velocity_mps, yaw_rate_radps = stick.twist(now_s)
                if stick.is_moving(now_s):
                    driver.twist(velocity_mps, yaw_rate_radps)
                speeds = f"{velocity_mps:+.2f} m/s {yaw_rate_radps:+.2f} rad/s"
                HANDLER.show(f"{speeds}  {100 * stick.share:.0f} %  {status}")
        finally:
            driver.twist(0.0, 0.0)
            HANDLER.show("")
    return 0


def limits_of(robot: Robot) -> VelocityLimits:
    """Return the limits in the robot's configuration; the defaults where it does not answer."""
    try:
        found = tomllib.loads(robot.query("config"))["controller"]["limits"]
        return VelocityLimits(velocity_mps=float(found["velocity_mps"]), yaw_rate_radps=float(found["yaw_rate_radps"]))
    except (ValueError, KeyError, TypeError):
        return VelocityLimits()


@contextmanager
def raw_keys() -> Iterator[int]:
    """Yield the terminal's file descriptor, on which keys arrive at once and are not shown; Ctrl-C stays a signal."""
    keys = sys.stdin.fileno()
    before = termios.tcgetattr(keys)
    try:
        tty.setcbreak(keys)
        yield keys
    finally:
        termios.tcsetattr(keys, termios.TCSADRAIN, before)


def read_keys(keys: int) -> bytes:
    """Return the bytes of the keys pressed within PERIOD_S, after a full PERIOD_S; raise OmnidError at the end."""
    time.sleep(PERIOD_S)
    if not select.select([keys], [], [], 0)[0]:
        return b""
    if not (found := os.read(keys, DEFAULT_BUFFER_SIZE)):
        raise OmnidError("the terminal was closed: the wheels stop")
    return found
