"""The camera driver on kernel devices, and `omnid run` under its unit: two guests, whose tests are reported here.

For the daemon the images of the sample log come from two loopback cameras; ttyS1 is connected to a simulated
controller on the host.
"""

from __future__ import annotations

import json
import select
import socket
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from calib.rig_file import rig_toml
from drivers.cameras.log_camera import LogPlayback
from drivers.frame import Frame
from drivers.logs.log_reader import LogReader
from omnid.runs.wiring import attached_rig
from omnid.stages.geometry import with_rims
from tests.contract.simulated_controllers import LONGEST_ABSENCE_S, SimulatedLine
from tests.hardware.image import ROOT, ImageUnavailableError, image
from tests.hardware.machine import Result, names_in, run_tests

pytestmark = pytest.mark.vm
SAMPLE = ROOT / "omnid/sample/log.mcap"
STEP_S = 0.01


class SimulatedBoard:
    """A simulated controller at the other end of ttyS1; it reports its state for each line received from ttyS2.

    A thread serves both within the block, also where no guest is connected.
    """

    def __init__(self, folder: Path) -> None:
        self._line, self._fastest_mps = SimulatedLine(), 0.0  # highest commanded speed of a wheel since the last report
        self._listeners: dict[socket.socket, Callable[[bytes], bytes]] = {}
        self.serial = list[str]()
        for name, answer in (("wheels", self._receive), ("questions", self._report)):
            listener = socket.socket(socket.AF_UNIX)
            listener.bind(str(folder / name))
            listener.listen()
            self._listeners[listener] = answer
            self.serial.append(f"unix:{folder / name}")
        self._halt = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> SimulatedBoard:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._halt.set()
        self._thread.join()

    def _serve(self) -> None:
        answers: dict[socket.socket, Callable[[bytes], bytes]] = {}
        last_s = time.monotonic()
        with ExitStack() as ends:
            for listener in self._listeners:
                ends.enter_context(listener)
            while not self._halt.is_set():
                readable, _, _ = select.select([*self._listeners, *answers], [], [], STEP_S)
                now_s = time.monotonic()
                self._line.base.advance(min(now_s - last_s, LONGEST_ABSENCE_S))
                last_s = now_s
                for port in readable:
                    if port in self._listeners:
                        answers[ends.enter_context(port.accept()[0])] = self._listeners[port]
                    elif data := port.recv(4096):
                        port.sendall(answers[port](data))
                    else:
                        del answers[port]

    def _receive(self, data: bytes) -> bytes:
        answer = self._line.feed(data)
        self._fastest_mps = max(self._fastest_mps, *map(abs, self._line.base.commanded_mps))
        return answer

    def _report(self, data: bytes) -> bytes:
        if b"\n" not in data:
            return b""
        base = self._line.base
        state = {
            "commanded_mps": max(map(abs, base.commanded_mps)),
            "fastest_mps": self._fastest_mps,
            "way_m": base.travel_m[0],
            **{name: getattr(base, name) for name in ("commands", "errors", "expiries", "unsafe_resumes")},
        }
        self._fastest_mps = state["commanded_mps"]
        return json.dumps(state).encode() + b"\n"


def rig_of_the_sample() -> bytes:
    """Return the rig of the sample log with the rims of the mirrors, which a daemon detects in the first images."""
    reader = LogReader(SAMPLE)
    try:
        rig = attached_rig(reader, SAMPLE)
    finally:
        reader.close()
    images = LogPlayback(SAMPLE).frames
    frames: list[Frame] = [frame for both in zip(*images.values(), strict=False) for _, frame in both]
    return rig_toml(with_rims(rig, frames)).encode()


@pytest.fixture(scope="module", autouse=True)
def guest_image() -> None:
    """Build the image if necessary; without QEMU the tests are skipped with a message that names the program."""
    try:
        image()
    except ImageUnavailableError as reason:
        pytest.skip(str(reason))


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Result:
    files = {"rig.toml": rig_of_the_sample()}
    with SimulatedBoard(tmp_path_factory.mktemp("ports")) as base:
        return run_tests("daemon.py", 2400, systemd=True, files=files, serial=base.serial)


@pytest.fixture(scope="module")
def cameras() -> Result:
    return run_tests("cameras.py", 400)


@pytest.mark.parametrize(
    ("script", "name"), [(script, name) for script in ("cameras", "daemon") for name in names_in(f"{script}.py")]
)
def test_in_the_guest(request: pytest.FixtureRequest, script: str, name: str) -> None:
    request.getfixturevalue(script).require_passed(name)
