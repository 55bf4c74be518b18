"""Logging: whole lines, journald's priorities where journald reads them, a rate limit per kind of line."""

from __future__ import annotations

import io
import logging
import os
import pty
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from select import select

import pytest

from omnid.engine.logging_setup import LOGGER, StderrHandler, priority

PATIENCE_S = 20.0  # bounds a wait on a loaded machine; not a measured limit
ROOT = Path(__file__).parents[3]
SETUP = "import logging; from omnid.engine.logging_setup import *; configure_logging(); configure_logging()\n"
LOG_THREE = SETUP + "log(logging.WARNING, 'one'); log(logging.ERROR, 'two'); log(logging.INFO, 'three')"


@dataclass
class Log:
    """A handler that writes into memory, with a clock set by hand."""

    stream: io.StringIO = field(default_factory=io.StringIO)
    now_s: float = 1000.0

    def __post_init__(self) -> None:
        self.handler = StderrHandler(self.stream, lambda: self.now_s)

    def __call__(self, level: int, text: str, name: str = LOGGER.name, **attributes: object) -> None:
        record = logging.makeLogRecord({"name": name, "levelno": level, "msg": text, **attributes})
        self.handler.handle(record)

    @property
    def lines(self) -> list[str]:
        return self.stream.getvalue().splitlines()


@pytest.fixture
def log() -> Log:
    return Log()


def run(environment: dict[str, str], stderr: int, script: str = LOG_THREE) -> int:
    """Return the exit code of a Python process that runs the script."""
    clean = {name: value for name, value in os.environ.items() if name != "JOURNAL_STREAM"}
    return subprocess.run([sys.executable, "-c", script], cwd=ROOT, env=clean | environment, stderr=stderr).returncode


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


def journal(stderr: int) -> dict[str, str]:
    """Return the environment in which journald reads the file descriptor."""
    found = os.fstat(stderr)
    return {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"}


def test_writes_priorities_for_journald(pipe: tuple[int, int]) -> None:
    assert run(journal(pipe[1]), pipe[1]) == 0
    assert os.read(pipe[0], 1000) == b"<4>one\n<3>two\n<6>three\n"


@pytest.mark.parametrize(
    ("level", "expected"),
    [(logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.DEBUG, 7), (35, 4)],
)
def test_maps_levels_to_priorities(level: int, expected: int) -> None:
    assert priority(level) == expected


@pytest.mark.parametrize("environment", [{}, {"JOURNAL_STREAM": "1:2"}, {"JOURNAL_STREAM": "nonsense"}])
def test_writes_plain_text_elsewhere(environment: dict[str, str], pipe: tuple[int, int]) -> None:
    """Also under systemd with another stderr."""
    assert run(environment, pipe[1]) == 0
    assert os.read(pipe[0], 1000) == b"omnid: warning: one\nomnid: two\nomnid: three\n"


def test_writes_a_repeated_line_a_few_times_and_counts_the_rest(log: Log) -> None:
    for number in range(1000):
        log(logging.WARNING, f"frame {number} is broken")
    log(logging.WARNING, "another fault")
    assert len(log.lines) == 6 and log.lines[4] == "omnid: warning: frame 4 is broken"
    assert log.handler.suppressed == 995
    log.now_s += 61
    log(logging.WARNING, "frame 1000 is broken")
    assert log.lines[6:] == ["omnid: warning: frame 1000 is broken (and 995 more of this kind)"]
    log(logging.WARNING, "frame 1001 is broken")
    assert log.lines[7:] == ["omnid: warning: frame 1001 is broken"]


def test_writes_unlimited_records_every_time(log: Log) -> None:
    for _ in range(20):
        log(logging.ERROR, "no such\nfile", unlimited=True)
    assert log.lines == ["omnid: no such file"] * 20


def test_the_command_line_writes_its_error_with_priority(pipe: tuple[int, int]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "omnid", "config", "--config", "/nowhere"],
        cwd=ROOT,
        env=os.environ | journal(pipe[1]),
        stderr=pipe[1],
    )
    assert done.returncode == 2
    assert os.read(pipe[0], 1000).startswith(b"<3>cannot read the settings file '/nowhere'")


def test_reports_suppressed_lines_once_at_the_end(log: Log) -> None:
    for _ in range(7):
        log(logging.WARNING, "camera 2 is dark")
    log.handler.flush()
    log.handler.flush()
    assert log.lines[5:] == ["omnid: 2 more of this kind: camera # is dark"]


def test_remembers_a_bounded_number_of_kinds(log: Log) -> None:
    letters = [chr(0x4E00 + number) for number in range(5000)]
    for letter in letters:
        log(logging.INFO, letter)
    assert len(log.lines) == 5000
    assert len(log.handler._kinds) == 256


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("two\nlines", "two lines"),
        ("\x1b[31mred\x00\x07", r"\x1b[31mred\x00\x07"),
        (" much   room ", "much room"),
        ("", ""),
        ("<0>panic", "<0>panic"),
        ("100 %s", "100 %s"),
    ],
)
def test_writes_one_printable_line_per_record(log: Log, text: str, line: str) -> None:
    log(logging.INFO, text)
    assert log.lines == [f"omnid: {line}"]


def test_bounds_the_length_of_a_line(log: Log) -> None:
    log(logging.INFO, "x" * 10**6)
    assert len(log.lines[0]) == len("omnid: ") + 4000


def test_keeps_lines_of_several_threads_whole(log: Log) -> None:
    def write(name: str) -> None:
        for _ in range(500):
            log(logging.INFO, name * 20)

    threads = [threading.Thread(target=write, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(log.lines) == sorted(f"omnid: {name * 20}" for name in "abcd" for _ in range(5))
    assert log.handler.suppressed == 4 * 495


def test_a_stream_that_cannot_be_written_is_no_error() -> None:
    closed = Log()
    closed.stream.close()
    closed(logging.ERROR, "lost")
    with open("/dev/full", "wb", buffering=0) as full:
        assert run({}, full.fileno()) == 0


def test_writes_warnings_of_libraries_with_their_name(pipe: tuple[int, int]) -> None:
    script = SETUP + (
        "library = logging.getLogger('library'); library.info('detail')\n"
        "library.warning('careful, %d', 7); library.critical('broken')"
    )
    assert run(journal(pipe[1]), pipe[1], script) == 0
    assert os.read(pipe[0], 1000) == b"<4>library: careful, 7\n<2>library: broken\n"


def test_a_library_user_gets_warnings_without_configuration(pipe: tuple[int, int]) -> None:
    script = "import logging; from omnid.engine.logging_setup import log; log(logging.WARNING, 'one'); log(20, 'two')"
    assert run({}, pipe[1], script) == 0
    assert os.read(pipe[0], 1000) == b"one\n"


def test_a_line_of_the_terminal_stays_below_the_others() -> None:
    master, slave = pty.openpty()
    with os.fdopen(slave, "w") as stream:
        handler = StderrHandler(stream)
        handler.show("one\nof " + 100 * "x")
        handler.handle(logging.makeLogRecord({"name": LOGGER.name, "levelno": logging.INFO, "msg": "hello"}))
        handler.show(f"{'1 m, ' * 15}55 messages dropped")
        handler.show("two")
        handler.show("")
        handler.handle(logging.makeLogRecord({"name": LOGGER.name, "levelno": logging.INFO, "msg": "end"}))
        shown = ""
        while not shown.endswith("end\r\n") and select([master], [], [], PATIENCE_S)[0]:  # it comes in pieces
            shown += os.read(master, 4096).decode()
    os.close(master)
    first = ("one of " + 100 * "x")[:79]  # of 80 columns: a wrapped line could not be erased
    assert shown == (
        f"\r\x1b[K{first}\r\x1b[Komnid: hello\r\n{first}\r\x1b[K{'1 m, ' * 14}1 m\r\x1b[Ktwo\r\x1b[Komnid: end\r\n"
    )


def test_nothing_is_shown_where_there_is_no_terminal() -> None:
    log = Log()
    log.handler.show("one")
    log(logging.INFO, "hello")
    assert log.stream.getvalue() == "omnid: hello\n"
