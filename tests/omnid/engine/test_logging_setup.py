"""Logging: whole lines, journald's priorities where journald reads them."""

from __future__ import annotations

import io
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from omnid.engine.logging_setup import LOGGER, StderrHandler

PATIENCE_S = 20.0  # bounds a wait on a loaded machine; not a measured limit
ROOT = Path(__file__).parents[3]
SETUP = "import logging; from omnid.engine.logging_setup import *; configure_logging(); configure_logging()\n"
LOG_THREE = SETUP + "log(logging.WARNING, 'one'); log(logging.ERROR, 'two'); log(logging.INFO, 'three')"
OF_A_LIBRARY = SETUP + (
    "library = logging.getLogger('library'); library.info('detail')\n"
    "library.warning('careful, %d', 7); library.critical('broken')"
)
UNCONFIGURED = "import logging; from omnid.engine.logging_setup import log; log(logging.WARNING, 'one'); log(20, 'two')"


@dataclass
class Log:
    """A handler that writes into memory."""

    stream: io.StringIO = field(default_factory=io.StringIO)

    def __post_init__(self) -> None:
        self.handler = StderrHandler(self.stream)

    def __call__(self, level: int, text: str, **attributes: object) -> None:
        self.handler.handle(logging.makeLogRecord({"name": LOGGER.name, "levelno": level, "msg": text, **attributes}))

    @property
    def lines(self) -> list[str]:
        return self.stream.getvalue().splitlines()


@pytest.fixture
def log() -> Log:
    return Log()


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


def run(environment: dict[str, str], stderr: int, *words: str) -> int:
    """Return the exit code of a Python process."""
    clean = {name: value for name, value in os.environ.items() if name != "JOURNAL_STREAM"}
    return subprocess.run([sys.executable, *words], cwd=ROOT, env=clean | environment, stderr=stderr).returncode


def journal(stderr: int) -> dict[str, str]:
    """Return the environment in which journald reads the file descriptor."""
    found = os.fstat(stderr)
    return {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"}


@pytest.mark.parametrize(
    ("script", "written"),
    [(LOG_THREE, b"<4>one\n<3>two\n<6>three\n"), (OF_A_LIBRARY, b"<4>library: careful, 7\n<2>library: broken\n")],
)
def test_writes_priorities_for_journald(pipe: tuple[int, int], script: str, written: bytes) -> None:
    assert run(journal(pipe[1]), pipe[1], "-c", script) == 0
    assert os.read(pipe[0], 1000) == written


def test_the_command_line_writes_its_error_with_priority(pipe: tuple[int, int]) -> None:
    assert run(journal(pipe[1]), pipe[1], "-m", "omnid", "config", "--config", "/nowhere") == 2
    assert os.read(pipe[0], 1000).startswith(b"<3>the settings file '/nowhere' cannot be read")


@pytest.mark.parametrize("environment", [{}, {"JOURNAL_STREAM": "1:2"}, {"JOURNAL_STREAM": "nonsense"}])
@pytest.mark.parametrize(
    ("script", "written"), [(LOG_THREE, b"omnid: warning: one\nomnid: two\nomnid: three\n"), (UNCONFIGURED, b"one\n")]
)
def test_writes_plain_text_elsewhere(
    environment: dict[str, str], pipe: tuple[int, int], script: str, written: bytes
) -> None:
    """Also under systemd with another stderr."""
    assert run(environment, pipe[1], "-c", script) == 0
    assert os.read(pipe[0], 1000) == written


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("two\nlines", "two lines"),
        ("\x1b[31mred\x00\x07", r"\x1b[31mred\x00\x07"),
        (" much   room ", "much room"),
        ("", ""),
        ("<0>panic", "<0>panic"),
        ("100 %s", "100 %s"),
        ("x" * 10**6, "x" * 4000),
    ],
)
def test_writes_one_printable_line_of_bounded_length_per_record(log: Log, text: str, line: str) -> None:
    log(logging.INFO, text)
    assert log.lines == [f"omnid: {line}"]


def test_a_stream_that_cannot_be_written_is_no_error() -> None:
    closed = Log()
    closed.stream.close()
    closed(logging.ERROR, "lost")
    with open("/dev/full", "wb", buffering=0) as full:
        assert run({}, full.fileno(), "-c", LOG_THREE) == 0
