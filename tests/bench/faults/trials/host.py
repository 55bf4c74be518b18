"""Faults of the host: its processes, its processor and its clocks."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from pathlib import Path

from omnid.core.control.safety_rules import POSE_STALE
from omnid.transport import codec
from tests.bench.faults.trials.trial import FAULTY_DAEMON, Outcome, Setting, driving, expect_motion, expect_stop, trial
from tests.replay.live import Operator, robot
from tests.waiting import PATIENCE_S, wait_until


@trial("SIGTERM in the middle of frames")
def sigterm(setting: Setting) -> Outcome:
    """Five times, at five moments within the period of the images."""
    for part in range(5):
        with (
            tempfile.TemporaryDirectory(dir=setting.folder) as folder,
            driving(Setting(setting.scene, Path(folder))) as (_, _, base),
        ):
            time.sleep(0.02 * part)
        speeds = [note.wheels_mps[0] for note in base.line.notes if note.wheels_mps[0] > 0]
        assert speeds[-1] < 0.2, "slowed down, not at once"
    return Outcome("exit 0, five of five", "slowed down to a stop", "")


@trial("daemon killed (SIGKILL)")
def killed(setting: Setting) -> Outcome:
    """The controller process goes on alone."""
    with robot(setting.scene, setting.folder) as (daemon, operator, base):
        operator.drive()
        expect_motion(base)
        controller_pid = daemon.controller_pid
        daemon.process.kill()
        expect_stop(base)
        wait_until(lambda: not Path(f"/proc/{controller_pid}").exists(), "its end")
        speeds = [note.wheels_mps[0] for note in base.line.notes if note.wheels_mps[0] > 0]
        assert speeds[-1] < 0.2, "slowed down, not at once"
    return Outcome("gone; the controller process ended by itself", "slowed down to a stop", "")


@trial("controller process killed")
def controller_killed(setting: Setting) -> Outcome:
    """The daemon cannot go on without it: systemd starts both again."""
    with robot(setting.scene, setting.folder) as (daemon, operator, base):
        operator.drive()
        expect_motion(base)
        os.kill(daemon.controller_pid, signal.SIGKILL)
        _, err = daemon.process.communicate(timeout=PATIENCE_S)
        assert daemon.process.returncode == 2 and "Traceback" not in err, err
        wait_until(lambda: base.twin.base.watchdog_expired and base.line.base.velocity_mps == 0, "its watchdog's stop")
    status = next(line for line in err.splitlines() if "controller process" in line)
    return Outcome("one line, exit 2", "the motor controller's watchdog", status)


@trial("daemon stuck for 3 s (SIGSTOP)")
def stuck(setting: Setting) -> Outcome:
    """The daemon gets no processor while setpoints go on; the controller process does."""
    with driving(setting) as (daemon, operator, base):
        daemon.process.send_signal(signal.SIGSTOP)
        expect_stop(base)
        assert not base.twin.base.watchdog_expired, "stopped by the controller process, not by the watchdog"
        operator.stop_sending()
        time.sleep(0.2)
        since_s = time.monotonic()
        daemon.process.send_signal(signal.SIGCONT)
        wait_until(lambda: f"stopped, {POSE_STALE}" in operator.values("wheels"), "the reason in the status")
        expect_stop(base)
        assert not base.line.moved_since(since_s + 0.5), "old setpoints are void"
        status = f"stopped, {POSE_STALE}"
        operator.drive()
        expect_motion(base)
    return Outcome("alive", "slowed down; stood until a new setpoint", status)


@trial("host overloaded: nothing of it runs for 2 s (SIGSTOP)")
def overloaded(setting: Setting) -> Outcome:
    """Neither the daemon nor the controller process runs while setpoints go on; later these have ended."""
    with driving(setting) as (daemon, operator, base):
        processes = [daemon.process.pid, daemon.controller_pid]
        for pid in processes:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(2.0)
        assert base.twin.base.watchdog_expired and not base.drives, "the motor controller's own watchdog"
        operator.stop_sending()
        time.sleep(0.2)
        since_s = time.monotonic()
        for pid in processes:
            os.kill(pid, signal.SIGCONT)
        wait_until(lambda: float(operator.values("wheels").get("tick_late_max_ms", 0)) > 1500, "the lateness")
        expect_stop(base)
        assert not base.line.moved_since(since_s + 0.5), "old setpoints are void"
        reasons = sorted(name for name in operator.values("wheels") if name.startswith("stopped"))
        operator.drive()
        expect_motion(base)
        assert base.line.base.unsafe_resumes == 0
    return Outcome("alive", "watchdog; stood until a new setpoint", ", ".join(reasons))


@trial("clock step of this machine")
def clock_step(setting: Setting) -> Outcome:
    """The daemon's time of day is an hour ahead, an hour behind, then 30 s ahead, each time right again after that.

    The operator's is not set: its setpoints look old, or of the future, which a stream that goes on may be.
    """
    with driving(setting, module=FAULTY_DAEMON) as (daemon, operator, base):
        for step_s in (3600, -3600, 30):
            daemon.write_line(f"clock {step_s}")
            wait_until(lambda step_s=step_s: abs(_ahead_s(operator) - step_s) < 10, "stamps that follow")
            if step_s > 0:
                wait_until(lambda: "refused, too old" in operator.values("wheels"), "the refusals")
                expect_stop(base)
            status = f"clock: {operator.message('clock')}; wheels: {operator.message('wheels')}"
            daemon.write_line("clock 0")
            wait_until(lambda: abs(_ahead_s(operator)) < 10, "stamps that are right again")
            expect_motion(base)
        wait_until(lambda: operator.values("clock").get("steps") == "6", "the count of steps")
    return Outcome("alive", "stopped where setpoints look old; recovered; stamps follow", status)


def _ahead_s(operator: Operator) -> float:
    """Return by how much the newest pose's stamp is ahead of the operator's clock."""
    return operator.poses[-1].stamp_ns * 1e-9 - time.time()


@trial("clock of the operator is another")
def another_clock(setting: Setting) -> Outcome:
    """It is an hour behind or ahead: that is refused, and obeyed with the stamps of the robot's own poses."""
    steps_s, status = (-3600.0, 3600.0), []
    with robot(setting.scene, setting.folder) as (daemon, operator, base):
        for step_s, reason in zip(steps_s, ("too old", "stamp in the future"), strict=True):
            for _ in range(20):
                operator.send("cmd/heading", codec.heading_cdr(time.time_ns() + round(step_s * 1e9), 0.3, 0.0))
            wait_until(lambda name=f"refused, {reason}": operator.values("wheels").get(name) == "20", "the refusals")
            assert not base.line.moved_since(0.0)
            status.append(f"{step_s:+g} s: refused as {reason!r}, counted")
        assert daemon.end()[0] == 0
    with (
        tempfile.TemporaryDirectory(dir=setting.folder) as folder,
        robot(setting.scene, Path(folder)) as (_, operator, base),
    ):
        wait_until(lambda: _repeats_the_stamp(operator) or base.drives, "motion", pause_s=0.05)
        expect_stop(base)
        status.append("with the stamp of the newest pose: driven")
    return Outcome("alive", "turned only where stated", "; ".join(status))


def _repeats_the_stamp(operator: Operator) -> None:
    """Send a setpoint with the stamp of the robot's newest pose."""
    operator.send("cmd/heading", codec.heading_cdr(operator.poses[-1].stamp_ns, 0.3, 0.0))
