"""The page and the keyboard as operators of a live daemon."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from omnid.core.control.safety_rules import ASKED, FAILED
from tests.omnid.web.servers import Shown, WebServer, served
from tests.replay.live import ROOT, command_line, patient, robot, started
from tests.replay.test_arming import MANUAL
from tests.waiting import PATIENCE_S, wait_until

pytest.importorskip("starlette", reason="needs the packages of omnid[web]")


def state(server: WebServer, holds: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    """Return the state on a page that is opened now, as soon as a condition holds."""
    found: dict[str, Any] = Shown(server).until("state", holds=holds)
    return found


def test_arm_and_stop_from_the_page_and_a_daemon_that_starts_again(tmp_path: Path, course: Path) -> None:
    with (
        robot(course, tmp_path, *MANUAL) as (daemon, operator, base),
        served("--connect", f"tcp/127.0.0.1:{daemon.port}") as server,
    ):
        operator.drive(0.3)
        assert not state(server, lambda found: found["wheels"] and found["pose"])["wheels"]["armed"]
        assert not base.line.moved_since(0.0)
        assert server.arm() == {"done": True, "text": "armed: it obeys commands from now on"}
        wait_until(lambda: base.drives, "motion")
        answer = server.post("/stop")
        assert answer["done"] and "stand until" in answer["text"]
        wait_until(lambda: not base.drives, "the stop")
        since_s = time.monotonic()
        # The status on the bus comes once a second: that of before /arm is not armed, either.
        stopped = state(server, lambda found: found["wheels"]["message"] == ASKED)
        assert not stopped["wheels"]["armed"]
        time.sleep(0.5)
        assert not base.line.moved_since(since_s), "the operator, who sends at 20 Hz, moves nothing"
        assert server.arm()["done"]
        base.unplug()
        wait_until(lambda: operator.message("wheels") == FAILED, "the fault")
        assert server.arm() == {"done": False, "text": f"omnid refuses: {FAILED}"}
        base.plug_in()
        assert daemon.end()[0] == 0
        gone = state(server, lambda found: found["alive"] is False and len(found["warnings"]) == 1)
        assert gone["wheels"] is None and gone["warnings"][0]["name"] == "robot"
        with started(command_line(course, daemon.port, base.port, *MANUAL), daemon.port):
            again = state(server, lambda found: found["alive"] and found["fresh"] and found["wheels"])
            assert not again["wheels"]["armed"]
            assert len(Shown(server).until("path")["points"]) < 200, "the path of the new start only"
        assert server.end() == (0, "")


UP = b"\x1b[A"
SLOWED = (*patient("controller.arming=manual"), "--pace", "0.5")  # what is seen matters little


@contextmanager
def keyboard(port: int) -> Iterator[tuple[int, subprocess.Popen[bytes]]]:
    """Yield the keyboard's end of the terminal of `omnid drive`, and its process."""
    keys, terminal = pty.openpty()
    command = [sys.executable, "-m", "omnid", "drive", "--connect", f"tcp/127.0.0.1:{port}"]
    with subprocess.Popen(command, cwd=ROOT, stdin=terminal, stdout=terminal, stderr=subprocess.PIPE) as process:
        os.close(terminal)
        try:
            yield keys, process
        finally:
            process.kill()
            os.close(keys)


def test_keys_arm_drive_and_stop(tmp_path: Path, course: Path) -> None:
    with robot(course, tmp_path, *SLOWED) as (daemon, operator, base), keyboard(daemon.port) as (keys, process):

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
