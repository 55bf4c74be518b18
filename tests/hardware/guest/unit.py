"""The unit in the guest: its state in systemd and its lines in the journal."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

SYSTEMD = Path("/opt/omnid/systemd")
DROP_INS = Path("/etc/systemd/system/omnid.service.d")
LIMIT_S = 400.0  # the clock of a guest on a busy host may run several times too fast


def run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True)
    journal = ("journalctl", "-u", "omnid", "-n", "40")  # why a unit does not start
    assert done.returncode == 0, done.stderr + subprocess.run(journal, capture_output=True, text=True).stdout
    return done.stdout.strip()


def show(what: str) -> str:
    return run("systemctl", "show", "omnid", "-p", what, "--value")


def until(what: Callable[[], object]) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not what():
        assert time.monotonic() < end_s, run("journalctl", "-u", "omnid", "--no-pager", "-n", "60")
        time.sleep(0.3)


def restarted(pid: int) -> None:
    """Wait until another process is the daemon."""
    until(lambda: int(show("MainPID")) not in (0, pid) and show("ActiveState") == "active")


def journal() -> list[tuple[int, str]]:
    """Return priority and text of all lines in the journal of the unit."""
    lines = run("journalctl", "-u", "omnid", "--no-pager", "-o", "json").splitlines()
    return [(int(entry["PRIORITY"]), entry["MESSAGE"]) for entry in map(json.loads, lines)]
