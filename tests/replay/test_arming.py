"""A live daemon: arming, by commands and by keys, and clocks that are set while it runs."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest
from mcap.reader import make_reader

from omnid.client import Robot
from omnid.core.control.arming import LOWER_PRIORITY, OPERATOR, OTHER_SENDER, PLANNER
from omnid.core.control.safety_rules import COMMAND_STALE, FAILED
from omnid.transport.status_names import STOPPED_PREFIX
from tests.ports import free_port
from tests.replay.command import Command
from tests.replay.live import Base, Daemon, Operator, patient, robot
from tests.waiting import OMNID, PATIENCE_S, ROOT, running, wait_until

# At half the speed of the log: the tests look at what is commanded.
MANUAL = (
    *patient("controller.arming=manual", "controller.deadlines.command_s=8"),
    "--pace",
    "0.5",
)
WATCH_S = 0.5  # during which nothing may move
HUNG_S = 4.0  # until the queues of subscribers that do not read are full; after 10 s zenoh drops them
TIMEOUT_STOP_S = float(re.findall(r"^TimeoutStopSec=(\d+)$", (ROOT / "systemd/omnid.service").read_text(), re.M)[0])


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Command:
    """Return the command line as a function."""
    return Command(capsys)


def expect_stand(operator: Operator, base: Base) -> None:
    """Expect that the wheels come to a stop and that the operator, who sends at 20 Hz, does not move them."""
    wait_until(lambda: not base.drives, "the stop")
    since_s, before = time.monotonic(), int(operator.values("wheels")["commands"])
    time.sleep(WATCH_S)
    wait_until(lambda: int(operator.values("wheels")["commands"]) > before + 5, "commands")
    assert not base.line.moved_since(since_s)


@pytest.mark.hazard("H01")
def test_nothing_moves_until_armed_and_a_stop_or_a_fault_lasts(tmp_path: Path, course: Path, command: Command) -> None:
    def omnid(daemon: Daemon, word: str) -> tuple[int, str]:
        """Run a command on this robot; return the exit code and its output."""
        code, out, err = command(word, "--connect", f"tcp/127.0.0.1:{daemon.port}")
        return code, out + err

    with robot(course, tmp_path, *MANUAL) as (daemon, operator, base):
        operator.drive(0.3)
        expect_stand(operator, base)
        assert operator.message("wheels") == "not armed since the start"
        assert omnid(daemon, "arm") == (0, "omnid is armed: it obeys commands from now on\n")
        wait_until(lambda: base.line.base.velocity_mps > 0.25, "motion")
        expect_the_operator_drives(daemon, operator, base)
        assert omnid(daemon, "stop") == (0, "omnid stops: its wheels stay stopped until `omnid arm`\n")
        expect_stand(operator, base)
        operator.arm()
        wait_until(lambda: base.drives, "motion after the release")
        base.unplug()
        wait_until(lambda: operator.message("wheels") == FAILED, "the fault")
        code, text = omnid(daemon, "arm")
        assert (code, text) == (1, f"omnid refuses: {FAILED}\n")
        base.plug_in()
        wait_until(lambda: operator.message("wheels") == f"not armed: {FAILED}", "the end of the fault")
        expect_stand(operator, base)
        operator.arm()
        wait_until(lambda: base.drives, "motion after the fault")
        code, err = daemon.end()
        assert err.count("two programs send commands as 'operator'") == 1
        assert code == 0 and f"arming is refused: {FAILED}" in err  # the wheels may have stood already: the log turns


def expect_the_operator_drives(daemon: Daemon, operator: Operator, base: Base) -> None:
    """Let a second program command as the operator, and a planner: backwards, at once with the operator."""

    def ignored(reason: str) -> int:
        return int(operator.values("wheels").get(f"ignored, {reason}", "0"))

    with Robot(connect=(f"tcp/127.0.0.1:{daemon.port}",)) as second:
        others, since_s = (second.driver(), second.driver(PLANNER)), time.monotonic()
        wait_until(
            lambda: (
                not any(driver.twist(-0.2, 0.5) for driver in others)
                and ignored(OTHER_SENDER) > 5
                and ignored(LOWER_PRIORITY) > 5
            ),
            "ignored commands",
        )
    assert operator.values("wheels")["source"] == OPERATOR
    assert all(note.wheels_mps[0] > 0.25 for note in list(base.line.notes) if note.at_s > since_s)


UP = b"\x1b[A"


@contextmanager
def keyboard(port: int) -> Iterator[tuple[int, subprocess.Popen[bytes]]]:
    """Yield the keyboard's end of the terminal of `omnid drive`, and its process."""
    keys, terminal = pty.openpty()
    command = [*OMNID, "drive", "--connect", f"tcp/127.0.0.1:{port}"]
    with subprocess.Popen(command, cwd=ROOT, stdin=terminal, stdout=terminal, stderr=subprocess.PIPE) as process:
        os.close(terminal)
        try:
            yield keys, process
        finally:
            process.kill()
            os.close(keys)


def test_keys_arm_drive_and_stop(tmp_path: Path, course: Path) -> None:
    with robot(course, tmp_path, *MANUAL) as (daemon, operator, base), keyboard(daemon.port) as (keys, process):

        def pressed(key: bytes) -> bool:
            os.set_blocking(keys, False)
            with suppress(BlockingIOError):
                os.read(keys, 65536)  # a terminal that is not read would block the program
            os.write(keys, key)
            time.sleep(0.1)
            return True

        wait_until(lambda: pressed(UP) and int(operator.values("wheels")["commands"]) > 5, "commands")
        assert not base.line.moved_since(0.0), "not armed"
        wait_until(lambda: pressed(b"a") and operator.values("wheels")["armed"] == "1", "the arming")
        wait_until(lambda: pressed(UP) and base.line.base.velocity_mps > 0.15, "motion")
        wait_until(lambda: not base.drives, "the stop without keys")
        wait_until(lambda: pressed(UP) and base.drives, "motion")
        wait_until(lambda: pressed(b" ") and not base.drives, "the stop")
        since_s = time.monotonic()
        for _ in range(10):
            pressed(UP)
        assert not base.line.moved_since(since_s), "a stop lasts until it is armed"
        pressed(b"q")
        _, err = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0 and err == b""
        assert daemon.end()[0] == 0


def test_without_a_robot_the_error_says_what_to_do() -> None:
    where = ("--connect", f"tcp/127.0.0.1:{free_port()}")
    with ExitStack() as ends:
        for process in [ends.enter_context(running([*OMNID, command, *where])) for command in ("arm", "stop")]:
            out, err = process.communicate(timeout=PATIENCE_S)
            assert process.returncode == 2 and out == ""
            assert err.startswith("omnid: cannot reach a robot at ") and err.count("\n") == 1


@pytest.mark.hazard("H41")
@pytest.mark.slow
def test_sigterm_with_subscribers_that_do_not_read_stops_the_wheels_and_ends_in_time(
    tmp_path: Path, course: Path
) -> None:
    """Three listeners get no processor; the daemon publishes panoramas for them. zenoh alone would wait for 20 s."""
    with ExitStack() as ends, robot(course, tmp_path, "--set", "bus.panorama_hz=10") as (daemon, operator, base):
        listeners = [_started_listener(ends, daemon) for _ in range(3)]
        operator.drive(0.3)
        wait_until(lambda: base.drives, "motion")
        for listener in listeners:
            listener.send_signal(signal.SIGSTOP)
        time.sleep(HUNG_S)
        daemon.process.send_signal(signal.SIGTERM)
        wait_until(lambda: not base.drives or not daemon.alive, "the stop")
        assert not base.drives, "the wheels stop before the daemon ends"
        _, err = daemon.process.communicate(timeout=TIMEOUT_STOP_S)
        assert daemon.process.returncode == 0 and "the bus has not closed within 3 s" in err, err
        assert not base.drives


def _started_listener(ends: ExitStack, daemon: Daemon) -> subprocess.Popen[str]:
    """Start `omnid listen` and return when it has shown a pose."""
    listener = ends.enter_context(running([*OMNID, "listen", "--connect", f"tcp/127.0.0.1:{daemon.port}"]))
    assert listener.stdout is not None
    wait_until(lambda: "tracking" in listener.stdout.readline(), "a pose")
    return listener


FAULTY = "tests.replay.faulty"
AHEAD_S = (3600, -3600, 30)  # of the daemon's clock, one after the other


def test_stamps_follow_the_clock_and_an_operator_drives_on_by_the_robots_own_time(course: Path, tmp_path: Path) -> None:
    recordings = tmp_path / "recordings"
    settings = patient(
        "record.enabled=true",
        "record.images_hz=0",
        f"record.folder='{recordings}'",
        "record.free_mb=0",
        "controller.deadlines.command_s=8",
    )
    with robot(course, tmp_path, *settings, module=FAULTY) as (daemon, operator, base):
        with Robot(connect=f"tcp/127.0.0.1:{daemon.port}") as client:
            driver = client.driver()

            def drives_at(ahead_s: float) -> bool:
                """Go on driving; true while it does, and poses are of the daemon's clock."""
                driver.heading(0.3, 0.0)
                return base.drives and abs(operator.poses[-1].stamp_ns * 1e-9 - time.time() - ahead_s) < 15

            wait_until(lambda: drives_at(0), "motion")
            for ahead_s in AHEAD_S:
                daemon.write_line(f"clock {ahead_s}")
                wait_until(lambda ahead_s=ahead_s: drives_at(ahead_s), "stamps of the new time")  # type: ignore[misc]
            assert f"{STOPPED_PREFIX}{COMMAND_STALE}" not in operator.values("wheels")
            # Who stamps by a clock that was not set is told why that does not count, and may arm by omnid's client.
            operator.drive()
            wait_until(lambda: "refused, too old" in operator.values("wheels"), "the refusal")
            assert "by the robot's clock; " in operator.values("wheels")["command_refusal"]
            assert driver.arm().done
        code, err = daemon.end()
    assert code == 0 and err.count("the computer's clock was set") == len(AHEAD_S)
    spans_s = []
    for path in recordings.glob("*.mcap"):
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None and summary.statistics is not None
        spans_s.append((summary.statistics.message_end_time - summary.statistics.message_start_time) * 1e-9)
    assert len(spans_s) == 1 + len(AHEAD_S) and max(spans_s) < 600, "a step begins a file, and is within none"
