"""The doctor: each check finds its faults, with advice, and is ok otherwise."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from calib.rig_file import read_rig, write_rig
from drivers.cameras.v4l2_device import CaptureDevice, V4l2Settings
from drivers.motors.protocols.motor_protocol import DifferentialDrive
from omnid.cli import main
from omnid.config import RecordConfig
from omnid.controller.motor import MotorSettings
from omnid.doctor import checks, wheel_wiring
from omnid.doctor.checks import Finding, bus, cameras, disk, motor, rig
from omnid.transport.session import BusConfig
from tests.contract.simulated_controllers import SIMULATED_CONTROLLERS, PtyMotor, SimulatedController
from tests.replay.command import Command

ROOT = Path(__file__).parents[3]


class DeviceTree:
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
def tree(tmp_path: Path) -> DeviceTree:
    return DeviceTree(tmp_path)


def test_the_doctor_accepts_cameras_that_are_connected(tree: DeviceTree) -> None:
    first, second = tree.examined()
    assert str(first) == "ok       camera lower  HD Webcam at /dev/video0"
    assert second.level == "ok" and "/dev/video2" in second.found


def test_the_doctor_finds_faults_of_cameras(tree: DeviceTree) -> None:
    (missing, right) = tree.examined(lower="/dev/omnid/lowest")
    assert missing.level == "error" and "/dev/omnid/lowest does not exist" in missing.found
    assert "omnid cameras" in missing.advice and right.level == "ok"
    (tree.root / "dev/null").touch()
    assert "is no camera" in tree.examined(lower="/dev/null")[0].found
    tree.known[0] = replace(tree.known[0], problem="is broken; mend it")
    assert "is broken" in str(tree.examined()[0]) and tree.examined()[0].level == "error"


@pytest.fixture
def port() -> Iterator[str]:
    """A pseudo-terminal as a serial port."""
    controller, own = os.openpty()
    yield os.ttyname(own)
    os.close(own)
    os.close(controller)


def test_the_doctor_checks_the_port_of_the_motor(port: str) -> None:
    settings = MotorSettings(port)
    os.chmod(port, 0o666)
    assert [str(finding) for finding in motor(settings)] == [f"ok       motor         line on {port}"]
    assert motor(MotorSettings("/dev/no-port")).__next__().level == "error"


def test_the_doctor_checks_the_space_for_recordings(tmp_path: Path) -> None:
    (found,) = disk(checks.STATE / "not" / "yet", RecordConfig(keep_mb=360, free_mb=0), 1e5)
    assert found.level == "ok" and f"free at {checks.STATE.parent}" in found.found and "some 1.0 h" in found.found
    for enabled, level in ((False, "warning"), (True, "error")):
        (found,) = disk(checks.STATE, RecordConfig(enabled=enabled, free_mb=10**9), 1e6)
        assert found.level == level and "record.free_mb = 1000000000" in found.found
    *_, found = disk(tmp_path, RecordConfig(free_mb=0), 1e6)
    assert found.level == "warning" and f"ReadWritePaths={tmp_path}" in found.advice
    unit = (ROOT / "systemd" / "omnid.service").read_text()
    assert f"\nWorkingDirectory={checks.STATE}\n" in unit and f"\nStateDirectory={checks.STATE.name}\n" in unit


def test_the_doctor_checks_the_rig(scene: Path, tmp_path: Path) -> None:
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
def test_the_doctor_warns_of_open_endpoints_without_rules(endpoint: str, local: bool) -> None:
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
    subjects = "camera lower,camera upper,rig,motor,real time,disk,bus"
    assert set(subjects.split(",")) <= {line[9:22].strip() for line in lines} and " errors, " in last
    assert main(["doctor", "--set", "cameras.widht_px=3"]) == 2
    assert "cameras.width_px" in capsys.readouterr().err


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
    """Standard input of the command: the answers of somebody who looks at the wheels, after those that are given."""

    def __init__(self, watched: WatchedController, capsys: pytest.CaptureFixture[str], given: Sequence[str]) -> None:
        self._watched, self._capsys, self._given = watched, capsys, list(given)

    def readline(self) -> str:
        """Return the answer to the question that was printed."""
        question, notes = self._capsys.readouterr().out, self._watched.notes
        if self._given:
            return self._given.pop(0)
        if "wheel that moved" in question:
            self._first = next(note for note in notes if any(note))
            notes.clear()
            left, right = (abs(speed) > 1e-6 for speed in self._first)
            return "n\n" if left == right else "l\n" if left else "r\n"
        return "n\n" if "forwards first" in question and sum(self._first) < 0 else "yes\n"


@pytest.mark.parametrize(
    ("given", "result"),
    [
        ((), "[motor.drive]\nswapped = true\nreverse_left = true\nreverse_right = false\ndifferent from"),
        (("yes", "n"), "did not move"),
        (("yes", "l", "y", "l", "y"), "which cannot be"),
        (("no",), "not begun"),
        (("",), "no answer"),
    ],
)
def test_the_wiring_follows_from_answers(
    given: tuple[str, ...], result: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    true = DifferentialDrive(wheel_radius_m=RADIUS_M, swapped=True, reverse_left=True)
    watched = WatchedController(SIMULATED_CONTROLLERS["roboteq"](true))
    monkeypatch.setattr(wheel_wiring, "MOVE_S", 0.3)
    monkeypatch.setattr("sys.stdin", Person(watched, capsys, given))
    # At 5 Hz an answer may take 0.16 s: a busy computer is not what is tested here.
    settings = ("protocol=roboteq", "watchdog_ms=1000", "rate_hz=5", f"drive.wheel_radius_m={RADIUS_M}")
    with contextlib.closing(PtyMotor(watched)) as motor:
        words = [word for setting in settings for word in ("--set", f"motor.{setting}")]
        code, out, err = Command(capsys)("motor", "test", "--motor", motor.port, "--speed", "0.4", *words)
        assert code == (2 if given else 0) and result in out + err and not any(motor.base.commanded_mps)


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
