"""The doctor: each check finds its faults, with advice, and is ok otherwise."""

from __future__ import annotations

import contextlib
import grp
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from calib.rig_file import read_rig, write_rig
from drivers.cameras.v4l2_controls import V4l2Settings
from drivers.cameras.v4l2_device import CaptureDevice
from drivers.motors.protocols.differential_drive import DifferentialDrive
from omnid.cli import main
from omnid.config import RecordConfig
from omnid.controller.motor import MotorSettings
from omnid.doctor import checks
from omnid.doctor.checks import Finding, bus, cameras, disk, motor, rig
from omnid.doctor.wheel_wiring import tested_drive as drive_by_answers
from omnid.errors import OmnidError
from omnid.transport.bus_config import BusConfig
from tests.contract.simulated_controllers import SIMULATED_CONTROLLERS, PtyMotor, SimulatedController
from tests.replay.command import Command
from tests.waiting import wait_until

ROOT = Path(__file__).parents[3]


class Robot:
    """A tree like /dev with two cameras and their persistent names."""

    def __init__(self, root: Path) -> None:
        self.root = root
        (root / "dev/omnid").mkdir(parents=True)
        self.known = []
        for number, name in ((0, "lower"), (2, "upper")):
            node = root / f"dev/video{number}"
            node.touch()
            node.chmod(0o666)
            (root / f"dev/omnid/{name}").symlink_to(node)
            self.known.append(CaptureDevice(f"/dev/video{number}", "HD Webcam", ""))

    def examined(self, lower: str = "/dev/omnid/lower", **how: str) -> list[Finding]:
        """Return the findings for both cameras with these settings."""
        wanted = {"lower": V4l2Settings(lower, **how), "upper": V4l2Settings("/dev/omnid/upper", **how)}  # type: ignore[arg-type]
        return list(cameras(wanted, self.known, self.root))


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return Robot(tmp_path)


def test_accepts_cameras_that_are_connected(robot: Robot) -> None:
    first, second = robot.examined()
    assert str(first) == "ok       camera lower  HD Webcam at /dev/video0"
    assert second.level == "ok" and "/dev/video2" in second.found


def test_finds_faults_of_cameras(robot: Robot) -> None:
    (missing, right) = robot.examined(lower="/dev/omnid/lowest")
    assert missing.level == "error" and "/dev/omnid/lowest does not exist" in missing.found
    assert "omnid cameras" in missing.advice and right.level == "ok"
    (robot.root / "dev/null").touch()
    assert "is no camera" in robot.examined(lower="/dev/null")[0].found
    assert robot.examined(lower="/dev/video2")[-1].found == "both names lead to one device"
    robot.known[0] = replace(robot.known[0], problem="is broken; mend it")
    assert "is broken" in str(robot.examined()[0]) and robot.examined()[0].level == "error"


@pytest.fixture
def port() -> Iterator[str]:
    """A pseudo-terminal as a serial port."""
    controller, own = os.openpty()
    yield os.ttyname(own)
    os.close(own)
    os.close(controller)


def test_checks_the_port_of_the_motor(port: str) -> None:
    settings = MotorSettings(port)
    os.chmod(port, 0o666)
    assert [str(finding) for finding in motor(settings)] == [f"ok       motor         line on {port}"]
    os.chmod(port, 0o660)
    group = grp.getgrgid(os.stat(port).st_gid).gr_name
    (found,) = motor(settings)
    assert found.level == "warning" and f"of group {group}" in found.found and 'GROUP="dialout"' in found.advice


def test_checks_the_space_for_recordings(tmp_path: Path) -> None:
    (found,) = disk(checks.STATE / "not" / "yet", RecordConfig(keep_mb=360, free_mb=0), 1e5)
    assert found.level == "ok" and f"free at {checks.STATE.parent}" in found.found and "some 1.0 h" in found.found
    for enabled, level in ((False, "warning"), (True, "error")):
        (found,) = disk(checks.STATE, RecordConfig(enabled=enabled, free_mb=10**9), 1e6)
        assert found.level == level and "record.free_mb = 1000000000" in found.found
    *_, found = disk(tmp_path, RecordConfig(free_mb=0), 1e6)
    assert found.level == "warning" and f"ReadWritePaths={tmp_path}" in found.advice
    unit = (ROOT / "systemd" / "omnid.service").read_text()
    assert f"\nWorkingDirectory={checks.STATE}\n" in unit and f"\nStateDirectory={checks.STATE.name}\n" in unit


def test_checks_the_rig(scene: Path, tmp_path: Path) -> None:
    size = read_rig(scene / "rig.toml").lower.camera.size
    *wrong, unknown = rig(scene / "rig.toml", (1280, 960))
    assert [one.level for one in wrong] == ["error", "error"] and "asks for 1280x960" in wrong[0].found
    assert unknown.level == "warning" and "does not state the height" in unknown.found
    assert [one.level for one in rig(scene / "rig.toml", size, -1.2)] == ["ok"]
    write_rig(tmp_path / "whole.toml", read_rig(scene / "rig.toml").at_height(1.2))
    (whole,) = rig(tmp_path / "whole.toml", size)
    assert whole.level == "ok" and "between the viewpoints, 1.200 m above the floor" in whole.found
    (unread,) = rig(tmp_path / "rig.toml", size)
    assert unread.level == "error" and "omnid calibrate" in str(unread)


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("unixsock-stream//run/x", True),
        ("tcp/[::]:7447", False),
    ],
)
def test_warns_of_open_endpoints_without_rules(endpoint: str, local: bool) -> None:
    for config in (BusConfig(listen=(endpoint,)), BusConfig(connect=(endpoint,))):
        found = bus(config)
        assert (found.level == "ok") == local and local != ("bus.config" in found.advice)


def test_the_command_runs_all_checks_and_returns_an_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = f"cameras.rig={tmp_path / 'rig.toml'}"
    assert main(["doctor", "--set", missing]) == 1
    *lines, last = capsys.readouterr().out.splitlines()
    assert {line[:9].strip() for line in lines} <= {"ok", "warning", "error"}
    subjects = "camera lower,camera upper,rig,motor,real time,memory,disk,bus"
    assert set(subjects.split(",")) <= {line[9:22].strip() for line in lines} and " errors, " in last
    assert main(["doctor", "--set", "cameras.widht_px=3"]) == 2
    assert "cameras.width_px" in capsys.readouterr().err


ROOT = Path(__file__).parents[3]
RADIUS_M = 0.02


class WatchedController:
    """A simulated controller that keeps the speeds of its wheels after each command."""

    def __init__(self, controller: SimulatedController) -> None:
        self._controller, self.base = controller, controller.base
        self.notes: list[tuple[float, float]] = []

    def feed(self, data: bytes) -> bytes:
        """Return the answers of the controller."""
        answer = self._controller.feed(data)
        self.notes.append((self.base.commanded_mps[0], self.base.commanded_mps[1]))
        return answer


class Person:
    """Looks at the wheels, and answers the questions."""

    def __init__(self, base: WatchedController) -> None:
        self.base = base
        self._travel_m = 0.0
        self.questions: list[str] = []

    def answer(self, question: str) -> str:
        """Return the answer to a question."""
        self.questions.append(question)
        if "wheel that moved" in question:
            moved = next(note for note in self.base.notes if any(note))
            self._first, self.base.notes[:] = moved, []
            left, right = (abs(speed) > 1e-6 for speed in moved)
            return "b" if left and right else "l" if left else "r"
        if "forwards first" in question:
            return "y" if sum(self._first) > 0 else "n"
        if "How many" in question:
            wait_until(
                lambda: (
                    not any(self.base.base.commanded_mps)
                    and self.base.base.velocity_mps == 0
                    and self.base.base.yaw_rate_radps == 0
                ),
                "wheels that stand",
            )
            return f"{(self.base.base.travel_m[0] - self._travel_m) / (math.tau * RADIUS_M):.3f}"
        self._travel_m = self.base.base.travel_m[0]
        return "yes"


@contextlib.contextmanager
def simulated(protocol: str, **wiring: object) -> Iterator[tuple[MotorSettings, Person, PtyMotor]]:
    """Yield settings that do not know the wiring, a person, and the base."""
    drive = DifferentialDrive(wheel_radius_m=RADIUS_M, gear=20.0)
    true = replace(drive, **wiring)  # type: ignore[arg-type]
    watched = WatchedController(SIMULATED_CONTROLLERS[protocol](true))
    with contextlib.closing(PtyMotor(watched)) as motor:
        # At 5 Hz an answer may take 0.16 s: a busy computer is not what is tested here.
        settings = MotorSettings(motor.port, protocol, rate_hz=5.0, watchdog_ms=1000, drive=drive)
        yield settings, Person(watched), motor


@pytest.mark.parametrize(
    ("answers", "message"),
    [(["n"], "did not move"), (["b"], "moved both"), (["l", "y", "l", "y"], "which cannot be")],
)
def test_answers_without_a_result(answers: list[str], message: str) -> None:
    with simulated("roboteq") as (config, _, motor):
        given = iter(["yes", *answers])
        with pytest.raises(OmnidError, match=message):
            drive_by_answers(config, lambda _: next(given), speed_mps=0.4, turns=0, move_s=0.05, rest_s=0.0)
        assert not any(motor.base.commanded_mps) and not list(given)


def test_the_command_asks_and_prints() -> None:
    with simulated("roboteq", swapped=True, reverse_left=True, gear=1.0) as (config, person, motor):
        command = [
            *(sys.executable, "-m", "omnid", "motor", "test", "--motor", config.port, "--turns", "1", "--speed", "0.4"),
            *("--set", "motor.protocol=roboteq", "--set", "motor.watchdog_ms=1000", "--set", "motor.rate_hz=5"),
            *("--set", f"motor.drive.wheel_radius_m={RADIUS_M}"),
        ]
        with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdin is not None and process.stdout is not None
            shown = ""
            while letter := process.stdout.read(1):
                shown += letter
                if shown.endswith(("? ", ": ")):
                    process.stdin.write(f"{person.answer(shown)}\n")
                    process.stdin.flush()
                    shown = ""
        assert process.returncode == 0 and not any(motor.base.commanded_mps)
    assert "forwards first" in " ".join(person.questions)
    assert "[motor.drive]\nswapped = true\nreverse_left = true" in shown and "different from the settings" in shown


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "no motor controller is configured"),
        (("--motor", "simulated"), "set there"),
        (("--motor", "simulated", "--set", "motor.protocol=vesc", "--speed", "9"), "--speed"),
    ],
)
def test_wrong_options_are_refused(words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert message in Command(capsys).refused("motor", "test", *words)


def test_without_yes_nothing_moves(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for text, message in (("no\n", "not begun"), ("", "no answer")):
        monkeypatch.setattr("sys.stdin", __import__("io").StringIO(text))
        code, _, err = Command(capsys)("motor", "test", "--motor", "simulated", "--set", "motor.protocol=vesc")
        assert code == 2 and message in err
