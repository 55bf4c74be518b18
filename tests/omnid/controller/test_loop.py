"""The loop of the controller process: what it receives before a tick, that no flood keeps the tick, and its end."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from omnid.controller import process
from omnid.controller.controller import Controller
from omnid.controller.ipc import Channel, socket_pair
from omnid.controller.messages import ControllerStart, ControllerUpdate
from omnid.controller.motor_settings import MotorSettings
from omnid.controller.process import ControllerLoop, run_controller
from omnid.controller.statistics import TickReport
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.control_law import ControllerPose
from omnid.core.control.safety_rules import ENDS
from omnid.engine.realtime import RealtimeSettings
from tests.contract.pty_motor import PtyMotor
from tests.omnid.controller.bench import AHEAD, PERIOD_S, UNATTENDED, Wheels

MANY = 100  # messages that wait together, more than one tick may leave over
PATIENCE_S = 30.0


def pose() -> ControllerPose:
    return ControllerPose(time.monotonic_ns(), 0.0, 0.0, "tracking")


def update(content: ControllerPose | TimedSetpoint) -> ControllerUpdate:
    return ControllerUpdate(0, content)


class Bench:
    """A loop in a thread, with the daemon's end of its channel."""

    def __init__(self, wheels: Wheels) -> None:
        ours, theirs = socket_pair()
        self.daemon, self.channel, self.wheels = Channel(ours), Channel(theirs), wheels
        self.controller = Controller(wheels, UNATTENDED, PERIOD_S)
        self.loop = ControllerLoop(self.channel, self.controller)
        self.thread = threading.Thread(target=self.loop.run)

    def drive(self) -> None:
        """Send a pose and then a setpoint, as the daemon does."""
        self.daemon.send(update(pose()))
        self.daemon.send(update(TimedSetpoint(time.monotonic_ns(), AHEAD)))

    def end(self) -> None:
        """End the daemon's side, and wait for the loop."""
        self.daemon.finish_sending()
        if self.thread.is_alive():
            self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive()


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench(Wheels())
    yield bench
    bench.end()
    bench.daemon.close()
    bench.channel.close()


def first_motion(wheels: Wheels) -> int:
    """Wait for a command that turns the wheels; return its number."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        for number, command in enumerate(list(wheels.commands)):
            if command.velocity_mps > 0:
                return number
        time.sleep(0.005)
    raise AssertionError("the wheels were never commanded to turn")


def test_the_first_tick_knows_all_that_waited_for_it(bench: Bench) -> None:
    for _ in range(MANY):
        bench.daemon.send(update(pose()))
    bench.drive()
    bench.thread.start()
    assert first_motion(bench.wheels) == 0


class Flooded(Channel):
    """A channel that is never empty until its end: the daemon sends faster than any process could receive."""

    def __init__(self, end: socket.socket) -> None:
        super().__init__(end)
        self.ended = False

    def receive(self, timeout_s: float) -> ControllerUpdate:
        """Return a message at once."""
        if self.ended:
            raise EOFError
        return update(pose())


def test_a_flood_of_messages_does_not_keep_a_tick() -> None:
    ours, theirs = socket_pair()
    wheels = Wheels()
    with ours, theirs:
        channel = Flooded(theirs)
        loop = ControllerLoop(channel, Controller(wheels, UNATTENDED, PERIOD_S))
        thread = threading.Thread(target=loop.run, daemon=True)  # without a tick it would never end
        thread.start()
        deadline_s = time.monotonic() + PATIENCE_S
        while len(wheels.commands) < 5:
            assert time.monotonic() < deadline_s, "no ticks beside a flood"
            time.sleep(0.01)
        channel.ended = True
        thread.join(PATIENCE_S)


def test_after_the_daemon_the_wheels_slow_down_to_a_stop(bench: Bench) -> None:
    bench.thread.start()
    deadline_s = time.monotonic() + PATIENCE_S
    while not bench.wheels.commands or bench.wheels.commands[-1].velocity_mps < 0.2:
        assert time.monotonic() < deadline_s
        bench.drive()
        time.sleep(PERIOD_S / 2)
    bench.end()
    speeds = [command.velocity_mps for command in bench.wheels.commands]
    assert speeds[-1] == 0.0 and bench.controller.state.reason == ENDS
    assert any(0.0 < speed < 0.19 for speed in speeds[speeds.index(max(speeds)) :]), "it slows down, and never jumps"


def test_the_loop_ends_in_time_where_the_wheels_do_not_stop(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "LONGEST_RAMP_S", 0.2)
    monkeypatch.setattr(Controller, "is_at_rest", property(lambda _: False))
    bench.thread.start()
    bench.end()


def test_ticks_keep_the_rhythm_of_the_settings() -> None:
    """The times at which ticks were due are multiples of the period, however late each was."""
    ours, theirs = socket_pair()
    daemon, period_s = Channel(ours), 0.04
    with contextlib.closing(PtyMotor()) as motor, ours:
        settings = MotorSettings(port=motor.port, rate_hz=1 / period_s, watchdog_ms=5000)
        daemon.send(ControllerStart(settings, UNATTENDED, RealtimeSettings(lock_memory=False, motor_priority=0)))
        thread = threading.Thread(target=run_controller, args=(Channel(theirs),))
        thread.start()
        due_s: list[float] = []
        while len(due_s) < 12:
            report = daemon.receive(PATIENCE_S)
            if isinstance(report, TickReport) and report.command is not None:
                due_s.append(report.command.stamp_ns * 1e-9 - report.late_s)
        daemon.finish_sending()
        thread.join(PATIENCE_S)
    periods = np.diff(due_s) / period_s
    assert np.abs(periods - periods.round()).max() < 0.01 and periods.round().min() == 1
