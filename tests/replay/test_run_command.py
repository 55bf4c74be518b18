"""`omnid run` as a process: poses, commands to the wheels, faults and the end."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from omnid.core.rig.rig_health import RigState
from omnid.formats.tum import read_tum
from tests.ports import free_port
from tests.replay.edited import images, save
from tests.replay.live import Base, Operator, answers, command_line, patient, robot, started
from tests.waiting import PATIENCE_S, wait_until

pytestmark = pytest.mark.usefixtures("default_signals")

SAMPLE = Path(str(files("omnid.sample") / "log.mcap"))


def test_the_run_publishes_poses_drives_the_wheels_and_ends_on_sigterm(tmp_path: Path, course: Path) -> None:
    recording = ("record.enabled=true", "record.images_hz=0", f'record.folder="{tmp_path / "log"}"')
    words = patient("controller.deadlines.command_s=2", *recording)
    with robot(course, tmp_path, *words) as (daemon, operator, base):
        expect_poses_of_the_scene(operator, course)
        expect_a_status_of_every_part(operator)
        assert not base.line.moved_since(0.0), "no command yet"
        operator.drive(0.3)
        wait_until(lambda: base.line.base.velocity_mps > 0.25, "motion")
        operator.stop_sending()
        wait_until(lambda: not base.drives, "the stop")
        stopped_s = time.monotonic()
        count = len(operator.poses)
        wait_until(lambda: len(operator.poses) > count + 5, "more poses")
        assert not base.line.moved_since(stopped_s), "no new command"
        wait_until(lambda: operator.message("wheels") == "no command", "the status without a command")
        operator.drive(0.3)
        wait_until(lambda: base.drives, "motion again")
        operator.send("cmd/stop", b"")
        wait_until(lambda: operator.values("wheels").get("stops") == "1", "the stop's count")
        operator.drive(0.2)
        wait_until(lambda: operator.message("wheels") == "a stop was asked for", "the stop in the status")
        operator.arm()
        wait_until(lambda: base.line.base.velocity_mps > 0.15, "motion after the stop")
        code, err = daemon.end()
        assert code == 0 and "Traceback" not in err, err
        assert not base.drives and base.line.base.errors == 0
        last = base.line.notes[-20:]
        assert any(0.0 < note.wheels_mps[0] < 0.19 for note in last), "it slowed down before the end"
    assert all(line.startswith("omnid: ") for line in err.splitlines())


@pytest.mark.hazard("H35")
def test_the_run_ends_where_the_cameras_are_exchanged(tmp_path: Path, scene: Path) -> None:
    """Before the wheels turn, in one line, with exit code 2."""
    taken = images(scene / "log.mcap")
    exchanged = [replace(image, camera="upper" if image.camera == "lower" else "lower") for image in taken]
    shutil.copy(scene / "rig.toml", tmp_path / "rig.toml")
    save(tmp_path / "log.mcap", exchanged)
    with closing(Base(tmp_path)) as base:
        command = [*command_line(tmp_path, free_port(), base.port), "--set", "obstacles.scan.floor_m=-1.2"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        assert not base.line.moved_since(0.0)
    # On a busy computer the motor may answer late meanwhile, which is a warning.
    late = ("gave no answer", "the motor controller is back")
    lines = [line for line in done.stderr.splitlines() if not any(words in line for words in late)]
    assert done.returncode == 2 and done.stdout == "" and len(lines) == 1, done.stderr
    assert "the images match better the other way round" in lines[0]


def expect_a_status_of_every_part(operator: Operator) -> None:
    wait_until(lambda: operator.message("recording") == "recording", "the status of the recording")
    assert operator.message("bus") == "open"
    wait_until(lambda: operator.values("rig").get("state") in list(RigState), "the state of the rig")


def expect_poses_of_the_scene(operator: Operator, course: Path) -> None:
    """On the path of the log, forwards and backwards, no pose is farther from the start than its end."""
    truth = read_tum(course / "truth.txt")
    longest_m = max(float(np.linalg.norm(T[:3, 3] - truth.T[0][:3, 3])) for T in truth.T)
    wait_until(lambda: len(operator.poses) >= 15, "fifteen poses")
    now_s = time.time()
    away_m = [float(np.linalg.norm(record.T_odom_base[:3, 3])) for record in operator.poses]
    assert max(away_m) < longest_m * 1.1 and longest_m > 0.2
    assert abs(operator.poses[-1].stamp_ns * 1e-9 - now_s) < PATIENCE_S, "stamps on the wire are Unix time"
    steps_ns = np.diff([record.stamp_ns for record in operator.poses])
    assert (steps_ns > 0).all()


def test_a_camera_fails_and_recovers(tmp_path: Path, course: Path) -> None:
    words = (*patient(), "--set", "controller.deadlines.pose_s=2")
    with robot(course, tmp_path, *words, module="tests.replay.faulty") as (daemon, operator, base):
        operator.drive()
        wait_until(lambda: base.drives, "motion")
        daemon.write_line("upper mute")
        wait_until(lambda: operator.message("pairing") == "no images of the upper camera", "the missing camera")
        wait_until(lambda: operator.message("odometry") == "no new pose", "stale odometry")
        wait_until(lambda: not base.drives, "the stop")
        assert operator.message("upper camera") == "no new image"
        assert operator.message("lower camera") == "streaming"
        daemon.write_line("upper ok")
        wait_until(lambda: base.drives, "motion without anybody's help")
        wait_until(lambda: operator.message("pairing") == "", "pairs")
        assert daemon.end()[0] == 0


def test_the_run_uses_the_attached_rig_and_ends_with_the_log() -> None:
    port = free_port()
    command = [sys.executable, "-m", "omnid", "run", "--log", str(SAMPLE), "--once", "--pace", "20"]
    command += ["--motor", "simulated", "--set", f'bus.listen=["tcp/127.0.0.1:{port}"]']
    with started(command, port) as daemon:
        _, err = daemon.process.communicate(timeout=PATIENCE_S)
    assert daemon.process.returncode == 0 and "Traceback" not in err, err


def test_a_signal_ends_the_run_without_output_at_any_time(scene: Path) -> None:
    """Also while the run starts."""
    port = free_port()
    words = ("--motor", "simulated", "--set", "obstacles.scan.floor_m=-1.2")
    with started(command_line(scene, port, None, *words), port) as daemon:
        wait_until(lambda: answers(port), "the bus")  # opened after cameras and motor, before anything runs
        code, err = daemon.end(signal.SIGINT)
    assert code == 0 and err == ""


@pytest.mark.hazard("H04")
def test_the_run_waits_for_the_motor_and_is_armed_only_after_the_answer(tmp_path: Path, course: Path) -> None:
    port, words = free_port(), patient('controller.arming="manual"', "motor.boot_s=0.5")
    with closing(Base(tmp_path)) as base:
        base.unplug()
        with started(command_line(course, port, base.port, *words), port) as daemon:
            wait_until(lambda: answers(port) or not daemon.alive, "the bus")
            with closing(Operator(port)) as operator:
                operator.drive(0.3)
                wait_until(lambda: len(operator.poses) > 5, "poses without a motor")
                wait_until(lambda: "waiting for the motor: motor port" in operator.message("wheels"), "the status")
                operator.arm()
                wait_until(lambda: "waiting" in operator.values("wheels").get("arm_refusal", ""), "the refusal")
                base.plug_in()
                wait_until(lambda: operator.message("wheels") == "not armed since the start", "its answer")
                assert not base.line.moved_since(0.0)
                operator.arm()
                wait_until(lambda: base.line.base.velocity_mps > 0.2, "motion")
            code, err = daemon.end()
    assert code == 0 and 1 <= err.count("waiting for the motor") < 5 and "the motor controller answers" in err
