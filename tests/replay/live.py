"""A live daemon as a process, with an operator on the bus and a simulated base that keeps its commands."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import zenoh
from rosbags.typesys import Stores, get_typestore

from omnid.transport import codec
from omnid.transport.codec import Pose
from tests.contract.simulated_controllers import PtyMotor, SimulatedLine
from tests.ports import free_port
from tests.waiting import ended, running, wait_until

COMMAND_PERIOD_S = 0.05  # of the operator's commands
STORE = get_typestore(Stores.ROS2_HUMBLE)


def answers(port: int) -> bool:
    """True if a server listens on the port."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


class CommandNote(NamedTuple):
    """The wheel speeds that were set at a time."""

    at_s: float
    wheels_mps: tuple[float, float]


class RecordedLine(SimulatedLine):
    """A simulated controller that keeps the wheel speeds of every command."""

    def __init__(self) -> None:
        super().__init__()
        self.notes: list[CommandNote] = []

    def feed(self, data: bytes) -> bytes:
        """Return the answers of the controller."""
        answer = super().feed(data)
        self.notes.append(CommandNote(time.monotonic(), (self.base.commanded_mps[0], self.base.commanded_mps[1])))
        return answer

    def moved_since(self, at_s: float) -> bool:
        """True if a wheel was commanded to turn after that time."""
        return any(note.at_s > at_s and any(note.wheels_mps) for note in list(self.notes))


class Base:
    """A simulated base behind a persistent name; it can be unplugged and plugged in again."""

    def __init__(self, folder: Path) -> None:
        self.line = RecordedLine()
        self.port = folder / "motor"
        self.twin = PtyMotor(self.line)
        self.port.symlink_to(self.twin.port)

    @property
    def drives(self) -> bool:
        """True if the wheels are commanded to turn now."""
        return any(self.line.base.commanded_mps)

    def unplug(self) -> None:
        """Remove the port."""
        self.port.unlink()
        self.twin.close()

    def plug_in(self) -> None:
        """Open another pty under the same name; the controller starts again."""
        self.line = RecordedLine()
        self.twin = PtyMotor(self.line)
        self.port.symlink_to(self.twin.port)

    def close(self) -> None:
        """Close the pty."""
        self.twin.close()


class Operator:
    """A zenoh peer: receives poses and statuses, and sends commands at 20 Hz between `drive` and `stop_sending`."""

    def __init__(self, port: int) -> None:
        config = zenoh.Config()
        settings = {
            "mode": "peer",
            "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
            "listen/endpoints": [],
            "scouting/multicast/enabled": False,
        }
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        self.poses: list[Pose] = []
        self.states: dict[str, Any] = {}  # newest status by name
        self.messages: set[tuple[str, str]] = set()  # part and message, all there were
        self._session = zenoh.open(config)
        self._session.declare_subscriber("omnid/odom", self._pose)
        self._session.declare_subscriber("omnid/status", self._state)
        self._wish: tuple[float, float] | None = None
        self._leaving = threading.Event()
        self._thread = threading.Thread(target=self._send_on, name="operator")
        self._thread.start()

    def drive(self, velocity_mps: float = 0.3, heading_rad: float = 0.0) -> None:
        """Send this command from now on."""
        self._wish = velocity_mps, heading_rad

    def stop_sending(self) -> None:
        """Send no more commands."""
        self._wish = None

    def arm(self) -> None:
        """Ask to arm."""
        self.send("cmd/arm", codec.header_cdr(time.time_ns()))

    def send(self, key: str, payload: bytes) -> None:
        """Send a message once."""
        self._session.put(f"omnid/{key}", payload, congestion_control=zenoh.CongestionControl.BLOCK)  # none is dropped

    def message(self, part: str) -> str:
        """Return the newest message of a status."""
        status = self.states.get(f"omnid: {part}")
        return "" if status is None else status.message

    def values(self, part: str) -> dict[str, str]:
        """Return the newest values of a status."""
        status = self.states.get(f"omnid: {part}")
        return {} if status is None else {pair.key: pair.value for pair in status.values}

    def close(self) -> None:
        """Close the session."""
        self._leaving.set()
        self._thread.join()
        self._session.close()  # type: ignore[no-untyped-call]

    def _send_on(self) -> None:
        while not self._leaving.wait(COMMAND_PERIOD_S):
            wish = self._wish
            if wish is not None:
                self.send(
                    "cmd/heading", codec.encoded(codec.VECTOR_SCHEMA, (time.time_ns(), "odom"), (wish[0], 0.0, wish[1]))
                )

    def _pose(self, sample: zenoh.Sample) -> None:
        self.poses.append(codec.decode_pose(sample.payload.to_bytes()))

    def _state(self, sample: zenoh.Sample) -> None:
        message: Any = STORE.deserialize_cdr(sample.payload.to_bytes(), codec.DIAGNOSTICS_SCHEMA)
        for status in message.status:
            if len(message.status) > 1:  # a single status only reports a new state of the odometry
                self.states[status.name] = status
            self.messages.add((status.name.removeprefix("omnid: "), status.message))


class Daemon:
    """A running daemon; `write_line` writes to the standard input of tests.replay.faulty."""

    def __init__(self, process: subprocess.Popen[str], port: int) -> None:
        self.process, self.port = process, port

    @property
    def alive(self) -> bool:
        """True if the process runs."""
        return self.process.poll() is None

    @property
    def controller_pid(self) -> int:
        """Process id of the controller."""
        tasks = Path(f"/proc/{self.process.pid}/task").iterdir()
        children = [int(word) for task in tasks for word in (task / "children").read_text().split()]
        return next(pid for pid in children if "omnid.controller.process" in Path(f"/proc/{pid}/cmdline").read_text())

    def write_line(self, line: str) -> None:
        """Write a line to its standard input."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str]:
        """Send a signal and return the exit code and stderr."""
        return ended(self.process, number)


def command_line(scene: Path, port: int, motor: Path | None, *words: object, module: str = "omnid") -> list[str]:
    """Return the command of `omnid run` on the images of a scene; without an operator, unless words change it."""
    run = [] if module != "omnid" else ["run"]
    log = ["--log", scene / "log.mcap", "--rig", scene / "rig.toml"]
    wheels = [] if motor is None else ["--motor", motor]
    settings = [
        f'bus.listen=["tcp/127.0.0.1:{port}"]',
        "live.status_s=0.2",
        "live.cloud_s=0.5",
        'controller.arming="automatic"',
        # Such small images show little of the floor ahead.
        "controller.collision.unknown=slow",
        "controller.collision.slow_mps=1",
    ]
    sets = [word for setting in settings for word in ("--set", setting)]
    return [sys.executable, "-m", module, *map(str, [*run, *log, *wheels, *sets, *words])]


def patient(*settings: str) -> tuple[str, ...]:
    """Return the words of these settings, and of those with which a robot on a busy machine, late with all, drives on.

    Otherwise each late pose, tick or answer would be a fault, and faults disarm; each late scan of obstacles a stop.
    """
    late = (
        "controller.deadlines.pose_s=8",
        "controller.deadlines.tick_s=8",
        "controller.collision.stale_s=8",
        "motor.watchdog_ms=8000",
        "controller.trust.velocity_sigma_mps=0",
        "controller.trust.yaw_rate_sigma_radps=0",
        "controller.trust.odometry_reset=ignore",
        "obstacles.rate_hz=2",  # which of all stages take the most time
    )
    return tuple(word for setting in (*settings, *late) for word in ("--set", setting))


@contextmanager
def started(command: list[str], port: int) -> Iterator[Daemon]:
    """Yield a daemon that is killed at the end of the block."""
    with running(command, stdin=subprocess.PIPE) as process:
        yield Daemon(process, port)


@contextmanager
def robot(scene: Path, folder: Path, *words: object, module: str = "omnid") -> Iterator[tuple[Daemon, Operator, Base]]:
    """Yield a daemon after its first pose, its operator, and its base, which stands."""
    port = free_port()
    with ExitStack() as ends:
        base = Base(folder)
        ends.callback(base.close)
        command = command_line(scene, port, base.port, *words, module=module)
        daemon = ends.enter_context(started(command, port))
        wait_until(lambda: answers(port) or not daemon.alive, "the bus")
        assert daemon.alive, daemon.process.communicate()[1]
        operator = Operator(port)
        ends.callback(operator.close)
        wait_until(lambda: operator.poses and operator.states, "a pose")
        yield daemon, operator, base


# A recording of `omnid run` with a driven simulated base


def recorded_run(scene: Path, folder: Path, poses: int) -> Path:
    """Return a recording of at least so many poses, at half speed so that an idle machine drops no image."""
    port, base, kept = free_port(), Base(folder), folder / "kept"
    more = (
        "--pace",
        "0.5",
        *patient("record.enabled=true", "record.images_hz=0", f"record.folder={kept}", "record.free_mb=0"),
    )
    with started(command_line(scene, port, base.port, *more), port) as daemon:
        wait_until(lambda: answers(port) or not daemon.alive, "the bus")
        operator = Operator(port)
        operator.drive(0.3)
        wait_until(lambda: len(operator.poses) > poses and base.line.base.velocity_mps > 0.2, "poses and motion")
        operator.close()
        code, err = daemon.end()
    base.close()
    assert code == 0, err
    (path,) = kept.glob("*.mcap")
    return path
