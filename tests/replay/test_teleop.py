"""`omnid drive` on a terminal: keys of a pseudo-terminal turn the wheels of a simulated base."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.replay.live import ROOT, patient, robot
from tests.waiting import PATIENCE_S, wait_until

UP = b"\x1b[A"
MANUAL = (*patient("controller.arming=manual"), "--pace", "0.5")  # what is seen matters little


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
        wait_until(lambda: pressed(UP) and base.line.base.velocity_mps > 0.2, "motion")
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
