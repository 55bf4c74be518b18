"""`omnid run` on a terminal: ready, a line that is rewritten, a summary."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

from tests.omnid.transport.bus_fixtures import free_endpoint
from tests.replay.command import Command

SAMPLE = Path(str(files("omnid.sample") / "log.mcap"))


def test_says_that_it_is_ready_and_ends_with_a_summary(tmp_path: Path) -> None:
    log, endpoint = tmp_path / "log.mcap", free_endpoint()
    with SAMPLE.open("rb") as sample:
        log.write_bytes(sample.read(450_000))
    master, slave = pty.openpty()
    command = [
        sys.executable,
        "-m",
        "omnid",
        "run",
        "--log",
        str(log),
        "--once",
        "--motor",
        "simulated",
        "--set",
        f'bus.listen=["{endpoint}"]',
    ]
    with subprocess.Popen(command, stdout=slave, stderr=slave, stdin=subprocess.DEVNULL) as process:
        os.close(slave)
        shown = b""
        while data := _read(master):
            shown += data
        assert process.wait() == 0
    os.close(master)
    text = shown.decode()
    ready = f"omnid: ready: poses of 'omnid' at {endpoint} (`omnid listen`); the wheels turn after `omnid arm`"
    assert ready in text and re.search(r"\x1b\[K\d+\.\d\d m .* poses/s, ", text)
    last = re.findall(r"omnid: .*", text)[-1]  # numba resets colours behind it where colorama is installed
    assert re.match(r"omnid: ended: \d+ poses, \d+\.\d\d m, 0 resets; tracking \d+", last)


def _read(master: int) -> bytes:
    try:
        return os.read(master, 4096)
    except OSError:  # the program has ended
        return b""


def test_a_log_is_read_by_its_topics(omnid: Command) -> None:
    exchanged = ("--lower", "/upper/image_raw/compressed", "--upper", "/lower/image_raw/compressed")
    listen = f'bus.listen=["{free_endpoint()}"]'
    assert "exchange --lower and --upper" in omnid("run", "--log", SAMPLE, "--once", "--set", listen, *exchanged).err
