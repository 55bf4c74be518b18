"""Faults of the motor controller, its port and the serial line."""

from __future__ import annotations

import random
import time

from omnid.core.control.safety_rules import FAILED
from tests.bench.faults.trials.trial import Outcome, Setting, driving, ended, expect_motion, expect_stop, trial
from tests.ports import free_port
from tests.replay.live import command_line
from tests.waiting import wait_until


@trial("serial port unplugged and back")
def unplugged(setting: Setting) -> Outcome:
    """The pty is closed; another one appears under the same name."""
    with driving(setting) as (_, operator, base):
        base.unplug()
        wait_until(lambda: operator.message("wheels") == FAILED, "the error in the status")
        status = f"wheels: {operator.message('wheels')}"
        operator.stop_sending()
        time.sleep(1.0)
        base.plug_in()
        wait_until(lambda: len(base.line.notes) > 10, "the first commands to the new motor controller")
        expect_stop(base)
        operator.drive()
        expect_motion(base)
    return Outcome("alive, opened the port again by itself", "watchdog; stood until a new setpoint", status)


@trial("serial garbage")
def serial_garbage(setting: Setting) -> Outcome:
    """Noise before each answer of the motor controller."""
    with driving(setting) as (_, operator, base):
        base.twin.garbage = random.Random(3).randbytes(200) + b"$S,9,9*0000\n"
        since_s = time.monotonic()
        time.sleep(2.0)
        assert base.line.moved_since(since_s), "good answers are found in the noise"
        status = f"wheels: {operator.message('wheels')}, errors {operator.values('wheels')['errors']}"
        base.twin.garbage = b""
        operator.stop_sending()
        expect_stop(base)
    return Outcome("alive", "drove on as commanded, stopped when the setpoints ended", status)


@trial("nothing but garbage on the serial line")
def only_garbage(setting: Setting) -> Outcome:
    """The answers are noise, as at a wrong baud rate."""
    noise = random.Random(6)
    with driving(setting) as (_, operator, base):
        base.twin.drop_input = True
        for _ in range(60):
            base.twin.send(noise.randbytes(80))
            time.sleep(0.03)
        wait_until(lambda: int(operator.values("wheels").get("errors", 0)) > 3, "errors counted")
        status = f"wheels: {operator.message('wheels')}"
        assert base.line.base.velocity_mps == 0, "the watchdog's stop"
        operator.stop_sending()
        base.twin.drop_input = False
        expect_stop(base)
        operator.drive()
        expect_motion(base)
        assert base.line.base.unsafe_resumes == 0
    return Outcome("alive", "its watchdog stopped them; stood until a new setpoint", status)


@trial("garbage on the way to the motor controller")
def line_garbage(setting: Setting) -> Outcome:
    """Another program writes noise into the port."""
    with driving(setting) as (_, operator, base):
        with open(base.port, "wb", buffering=0) as line:
            line.write(random.Random(4).randbytes(500))
        wait_until(lambda: base.line.base.errors > 100, "the controller's count")
        status = f"wheels: {operator.message('wheels')}, errors {operator.values('wheels')['errors']}"
        operator.stop_sending()
        expect_stop(base)
    return Outcome("alive", "as commanded; the CRC refused the noise", status)


@trial("motor controller does not answer, then does")
def silent(setting: Setting) -> Outcome:
    """The motor controller neither receives nor answers."""
    with driving(setting) as (_, operator, base):
        base.twin.drop_input = True
        wait_until(lambda: int(operator.values("wheels").get("errors", 0)) > 3, "errors counted")
        wait_until(lambda: base.twin.base.watchdog_expired and base.line.base.velocity_mps == 0, "its watchdog's stop")
        status = f"wheels: {operator.message('wheels')}"
        operator.stop_sending()
        base.twin.drop_input = False
        expect_stop(base)
        operator.drive()
        expect_motion(base)
        assert base.line.base.unsafe_resumes == 0
    return Outcome("alive", "its watchdog stopped them; stood until a new setpoint", status)


@trial("two daemons on one serial device")
def two_daemons(setting: Setting) -> Outcome:
    """The second is refused; the first drives on."""
    with driving(setting) as (_, _, base):
        code, err = ended(command_line(setting.scene, free_port(), base.port))
        assert code == 2 and err.count("\n") == 1 and "in use" in err, err
        since_s = time.monotonic()
        time.sleep(0.5)
        assert base.line.moved_since(since_s) and base.line.base.errors == 0
    return Outcome("second: one line, exit 2; first: alive", "as the first's operator commanded", err.strip())
