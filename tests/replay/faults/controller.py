"""Faults of the controller, its port and the line to it."""

from __future__ import annotations

import random
import time

from omnid.core.control.safety_rules import FAILED
from tests.replay.faults.trial import Outcome, Place, driving, ended, goes_on, stands, trial
from tests.replay.live import command_line, free_port, wait_until


@trial("serial port unplugged and back")
def unplugged(place: Place) -> Outcome:
    """The pty is closed; another one appears under the same name."""
    with driving(place) as (_, operator, base):
        base.unplug()
        wait_until(lambda: operator.message("wheels") == FAILED, "an error told of the wheels")
        said = f"wheels: {operator.message('wheels')}"
        operator.stop_sending()
        time.sleep(1.0)
        base.plug_in()
        wait_until(lambda: len(base.line.notes) > 10, "the new controller's first commands")
        stands(base)
        operator.drive()
        goes_on(base)
    return Outcome("alive, opened the port again by itself", "watchdog; stood until a fresh command", said)


@trial("serial garbage")
def serial_garbage(place: Place) -> Outcome:
    """Noise before each answer of the controller."""
    with driving(place) as (_, operator, base):
        base.twin.garbage = random.Random(3).randbytes(200) + b"$S,9,9*0000\n"
        since_s = time.monotonic()
        time.sleep(2.0)
        assert base.line.moved_since(since_s), "good answers are found in the noise"
        said = f"wheels: {operator.message('wheels')}, errors {operator.values('wheels')['errors']}"
        base.twin.garbage = b""
        operator.stop_sending()
        stands(base)
    return Outcome("alive", "drove on as asked, stopped when commands ceased", said)


@trial("nothing but garbage on the serial line")
def only_garbage(place: Place) -> Outcome:
    """The controller's answers are noise, as at a wrong baud rate."""
    noise = random.Random(6)
    with driving(place) as (_, operator, base):
        base.twin.drop_input = True
        for _ in range(60):
            base.twin.send(noise.randbytes(80))
            time.sleep(0.03)
        wait_until(lambda: int(operator.values("wheels").get("errors", 0)) > 3, "errors counted")
        said = f"wheels: {operator.message('wheels')}"
        assert base.line.base.velocity_mps == 0, "the watchdog's stop"
        operator.stop_sending()
        base.twin.drop_input = False
        stands(base)
        operator.drive()
        goes_on(base)
        assert base.line.base.unsafe_resumes == 0
    return Outcome("alive", "its watchdog stopped them; stood until a fresh command", said)


@trial("garbage on the way to the controller")
def line_garbage(place: Place) -> Outcome:
    """Another program writes noise into the port."""
    with driving(place) as (_, operator, base):
        with open(base.port, "wb", buffering=0) as line:
            line.write(random.Random(4).randbytes(500))
        wait_until(lambda: base.line.base.errors > 100, "the controller's count")
        said = f"wheels: {operator.message('wheels')}, errors {operator.values('wheels')['errors']}"
        operator.stop_sending()
        stands(base)
    return Outcome("alive", "as asked; the CRC refused the noise", said)


@trial("controller silent, then back")
def silent(place: Place) -> Outcome:
    """The controller neither hears nor answers."""
    with driving(place) as (_, operator, base):
        base.twin.drop_input = True
        wait_until(lambda: int(operator.values("wheels").get("errors", 0)) > 3, "errors counted")
        wait_until(lambda: base.twin.watchdog_expired and base.line.base.velocity_mps == 0, "its watchdog's stop")
        said = f"wheels: {operator.message('wheels')}"
        operator.stop_sending()
        base.twin.drop_input = False
        stands(base)
        operator.drive()
        goes_on(base)
        assert base.line.base.unsafe_resumes == 0
    return Outcome("alive", "its watchdog stopped them; stood until a fresh command", said)


@trial("two daemons on one serial device")
def two_daemons(place: Place) -> Outcome:
    """The second is refused; the first drives on."""
    with driving(place) as (_, _, base):
        code, err = ended(command_line(place.scene, free_port(), base.port))
        assert code == 2 and err.count("\n") == 1 and "in use" in err, err
        since_s = time.monotonic()
        time.sleep(0.5)
        assert base.line.moved_since(since_s) and base.line.base.errors == 0
    return Outcome("second: one line, exit 2; first: alive", "as the first's operator asked", err.strip())
