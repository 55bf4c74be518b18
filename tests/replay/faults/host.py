"""Faults of the host: its processes, its processor and its clocks."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from itertools import pairwise
from pathlib import Path

from omnid.core.control.safety_rules import POSE_STALE
from omnid.transport import codec
from tests.replay.faults.trial import SPOILT, Outcome, Place, driving, goes_on, stands, trial
from tests.replay.live import PATIENCE_S, Base, Operator, robot, wait_until


@trial("SIGTERM in the middle of frames")
def sigterm(place: Place) -> Outcome:
    """Five times, at five moments of a image."""
    for part in range(5):
        with tempfile.TemporaryDirectory(dir=place.folder) as folder, \
                driving(Place(place.scene, Path(folder))) as (_, _, base):
            time.sleep(0.02 * part)
        speeds = [note.wheels_mps[0] for note in base.line.notes if note.wheels_mps[0] > 0]
        assert speeds[-1] < 0.2, "slowed down, not at once"
    return Outcome("exit 0, five of five", "slowed down to a stand", "")


@trial("daemon killed (SIGKILL)")
def killed(place: Place) -> Outcome:
    """The process that steers is left alone."""
    with robot(place.scene, place.folder) as (daemon, operator, base):
        operator.drive()
        goes_on(base)
        steering = daemon.controller_pid
        daemon.process.kill()
        stands(base)
        wait_until(lambda: not Path(f"/proc/{steering}").exists(), "its end")
        speeds = [note.wheels_mps[0] for note in base.line.notes if note.wheels_mps[0] > 0]
        assert speeds[-1] < 0.2, "slowed down, not at once"
    return Outcome("gone; what steers ended by itself", "slowed down to a stand", "")


@trial("the process that steers killed")
def steering_killed(place: Place) -> Outcome:
    """The daemon cannot go on without it: systemd starts both anew."""
    with robot(place.scene, place.folder) as (daemon, operator, base):
        operator.drive()
        goes_on(base)
        os.kill(daemon.controller_pid, signal.SIGKILL)
        _, err = daemon.process.communicate(timeout=PATIENCE_S)
        assert daemon.process.returncode == 2 and "Traceback" not in err, err
        wait_until(lambda: base.twin.watchdog_expired and base.line.base.velocity_mps == 0, "its watchdog's stop")
    said = next(line for line in err.splitlines() if "controller process" in line)
    return Outcome("one line, exit 2", "the controller's watchdog", said)


@trial("daemon stuck for 3 s (SIGSTOP)")
def stuck(place: Place) -> Outcome:
    """The daemon gets no processor while commands go on; what steers does."""
    with driving(place) as (daemon, operator, base):
        daemon.process.send_signal(signal.SIGSTOP)
        stands(base)
        assert not base.twin.watchdog_expired, "stopped by what steers, not by the controller"
        operator.stop_sending()
        time.sleep(0.2)
        since_s = time.monotonic()
        daemon.process.send_signal(signal.SIGCONT)
        wait_until(lambda: f"stopped, {POSE_STALE}" in operator.values("wheels"), "the reason told")
        stands(base)
        assert not base.line.moved_since(since_s + 0.5), "old commands are void"
        said = f"stopped, {POSE_STALE}"
        operator.drive()
        goes_on(base)
    return Outcome("alive", "slowed down; stood until a fresh command", said)


@trial("host overloaded: nothing of it runs for 2 s (SIGSTOP)")
def overloaded(place: Place) -> Outcome:
    """Neither the daemon nor what steers gets a processor while commands go on; then they have ceased."""
    with driving(place) as (daemon, operator, base):
        processes = [daemon.process.pid, daemon.controller_pid]
        for pid in processes:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(2.0)
        assert base.twin.watchdog_expired and not base.drives, "the controller's own watchdog"
        operator.stop_sending()
        time.sleep(0.2)
        since_s = time.monotonic()
        for pid in processes:
            os.kill(pid, signal.SIGCONT)
        wait_until(lambda: float(operator.values("wheels").get("tick_late_max_ms", 0)) > 1500, "its lateness told")
        stands(base)
        assert not base.line.moved_since(since_s + 0.5), "old commands are void"
        reasons = sorted(name for name in operator.values("wheels") if name.startswith("stopped"))
        operator.drive()
        goes_on(base)
        assert base.line.base.unsafe_resumes == 0
    return Outcome("alive", "watchdog; stood until a fresh command", ", ".join(reasons))


@trial("clock step of this machine")
def clock_step(place: Place) -> Outcome:
    """The daemon's time of day is an hour ahead, an hour behind, then 30 s ahead, then right again."""
    with driving(place, module=SPOILT) as (daemon, operator, base):
        for step_s in (3600, -3600):
            daemon.write_line(f"clock {step_s}")
            time.sleep(0.5)
            goes_on(base)
        daemon.write_line("clock 30")
        wait_until(lambda: "refused, too old" in operator.values("wheels"), "the refusals")
        stands(base)
        said = f"wheels: {operator.message('wheels')}; refused: too old"
        daemon.write_line("clock 0")
        goes_on(base)
        steps_s = [(b.stamp_ns - a.stamp_ns) * 1e-9 for a, b in pairwise(operator.poses)]
        assert min(steps_s) > 0 and max(steps_s) < 20, "stamps of poses are of one clock and one offset"
    return Outcome("alive", "drove on at an hour's step; stopped at 30 s, when commands look old; recovered", said)


@trial("clock of the operator is another")
def another_clock(place: Place) -> Outcome:
    """It is an hour ahead or behind, then 30 s behind."""
    with robot(place.scene, place.folder) as (daemon, operator, base):
        said = []
        for step_s in (3600.0, -3600.0):
            send_until(operator, base, step_s)
            stands(base)
            said.append(f"{step_s:+g} s: driven by their arrival")
        for _ in range(20):
            operator.send("cmd/heading", codec.heading_cdr(time.time_ns() - 30 * 10**9, 0.3, 0.0))
            time.sleep(0.02)
        wait_until(lambda: operator.values("wheels").get("refused, too old") == "20", "the refusals")
        assert not base.drives
        said.append("-30 s: refused as too old, counted")
        assert daemon.end()[0] == 0
    return Outcome("alive", "turned only where stated", "; ".join(said))


def send_until(operator: Operator, base: Base, step_s: float) -> None:
    """Commands with the stamps of another clock, until the wheels turn."""
    deadline_s = time.monotonic() + 30
    while not base.drives:
        assert time.monotonic() < deadline_s
        operator.send("cmd/heading", codec.heading_cdr(time.time_ns() + round(step_s * 1e9), 0.3, 0.0))
        time.sleep(0.05)
