"""`omnid motor test` on simulated controllers with another wiring than that of the settings."""

from __future__ import annotations

import contextlib
import math
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from omnid.controller.motor_settings import DriveSettings, MotorSettings
from omnid.doctor.wheel_wiring import tested_drive as drive_by_answers
from omnid.errors import OmnidError
from tests.contract.pty_motor import PtyMotor
from tests.contract.simulated_controllers import SIMULATED_CONTROLLERS, SimulatedController
from tests.replay.command import Command
from tests.waiting import wait_until

ROOT = Path(__file__).parents[3]
RADIUS_M = 0.02
LATE_S = 0.25  # more than an answer may take


class WatchedController:
    """A simulated controller that keeps the speeds of its wheels after each command."""

    def __init__(self, controller: SimulatedController) -> None:
        self._controller, self.base = controller, controller.base
        self.notes: list[tuple[float, float]] = []
        self.late_stops = 0  # stops of wheels that turn whose answers are still to come late

    def feed(self, data: bytes) -> bytes:
        """Return the answers of the controller."""
        did_turn = any(self.base.commanded_mps)
        answer = self._controller.feed(data)
        if self.late_stops and did_turn and not any(self.base.commanded_mps):
            self.late_stops -= 1
            time.sleep(LATE_S)
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
    drive = DriveSettings(wheel_radius_m=RADIUS_M, gear=20.0)
    true = replace(drive.geometry(), **wiring)  # type: ignore[arg-type]
    watched = WatchedController(SIMULATED_CONTROLLERS[protocol](true))
    with contextlib.closing(PtyMotor(watched)) as motor:
        # At 5 Hz an answer may take 0.16 s: a busy computer is not what is tested here.
        settings = MotorSettings(motor.port, protocol, rate_hz=5.0, watchdog_ms=1000, drive=drive)
        yield settings, Person(watched), motor


@pytest.mark.parametrize(
    ("protocol", "true"),
    [
        ("roboteq", {"swapped": True, "reverse_left": True, "gear": 10.0}),
        pytest.param("odrive_ascii", {"swapped": True, "gear": 40.0}, marks=pytest.mark.slow),
        pytest.param("vesc", {"reverse_left": True, "reverse_right": True, "gear": 10.0}, marks=pytest.mark.slow),
    ],
)
def test_the_settings_follow_from_what_the_wheels_did(protocol: str, true: dict[str, object]) -> None:
    with simulated(protocol, **true) as (config, person, motor):
        drive = drive_by_answers(config, person.answer, speed_mps=0.4, turns=4, move_s=0.1, rest_s=0.05)
        assert not any(motor.base.commanded_mps)
    expected = {"swapped": False, "reverse_left": False, "reverse_right": False, **true}
    for name, value in expected.items():
        found = getattr(drive, name)
        assert found == value if isinstance(value, bool) else found == pytest.approx(value, rel=0.2), (name, found)
    assert drive.track_m == config.drive.track_m and "forwards first" in " ".join(person.questions)


@pytest.mark.parametrize(
    ("answers", "message"),
    [(["n"], "did not move"), (["b"], "moved both"), (["l", "y", "l", "y", "", "n"], "did not move")],
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
    assert "[motor.drive]\nswapped = true\nreverse_left = true" in shown and "different from the settings" in shown


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "no motor controller is configured"),
        (("--motor", "simulated"), "set there"),
        (("--motor", "simulated", "--set", "motor.protocol=vesc", "--speed", "9"), "--speed"),
        (("--motor", "simulated", "--set", "motor.protocol=vesc", "--turns", "-1"), "--turns"),
    ],
)
def test_wrong_options_are_refused(words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert message in Command(capsys).refused("motor", "test", *words)


def test_without_yes_nothing_moves(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for text, message in (("no\n", "not begun"), ("", "no answer")):
        monkeypatch.setattr("sys.stdin", __import__("io").StringIO(text))
        code, _, err = Command(capsys)("motor", "test", "--motor", "simulated", "--set", "motor.protocol=vesc")
        assert code == 2 and message in err
