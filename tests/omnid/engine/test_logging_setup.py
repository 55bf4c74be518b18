"""What is said: whole lines, the journal's priorities where the journal reads them, and no flood."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from omnid.engine.logging_setup import ERROR, NOTICE, WARNING, Journal

ROOT = Path(__file__).parents[3]
SPEAK = "from omnid.engine.logging_setup import *; say(WARNING, 'one'); say(ERROR, 'two'); say(NOTICE, 'three')"


@dataclass
class Spoken:
    """A journal that writes into memory, and a clock that is set by hand."""

    stream: io.StringIO = field(default_factory=io.StringIO)
    now_s: float = 1000.0

    def __post_init__(self) -> None:
        self.journal = Journal(self.stream, lambda: self.now_s)

    @property
    def lines(self) -> list[str]:
        return self.stream.getvalue().splitlines()


@pytest.fixture
def spoken() -> Spoken:
    return Spoken()


def said(environment: dict[str, str], stderr: int, script: str = SPEAK) -> int:
    """Speaks in a process of its own."""
    clean = {name: value for name, value in os.environ.items() if name != "JOURNAL_STREAM"}
    return subprocess.run([sys.executable, "-c", script], cwd=ROOT, env=clean | environment, stderr=stderr).returncode


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


def test_the_journal_gets_priorities(pipe: tuple[int, int]) -> None:
    found = os.fstat(pipe[1])
    assert said({"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"}, pipe[1]) == 0
    assert os.read(pipe[0], 1000) == b"<4>one\n<3>two\n<5>three\n"


@pytest.mark.parametrize("environment", [{}, {"JOURNAL_STREAM": "1:2"}, {"JOURNAL_STREAM": "nonsense"}])
def test_anybody_else_gets_text(environment: dict[str, str], pipe: tuple[int, int]) -> None:
    """Also under systemd, where stderr leads elsewhere."""
    assert said(environment, pipe[1]) == 0
    assert os.read(pipe[0], 1000) == b"omnid: warning: one\nomnid: two\nomnid: three\n"


def test_a_fault_that_repeats_itself_is_written_a_few_times_and_counted(spoken: Spoken) -> None:
    for number in range(1000):
        spoken.journal.say(WARNING, f"frame {number} is broken")
    spoken.journal.say(WARNING, "another fault")
    assert len(spoken.lines) == 6 and spoken.lines[4] == "omnid: warning: frame 4 is broken"
    assert spoken.journal.held_back == 995
    spoken.now_s += 61
    spoken.journal.say(WARNING, "frame 1000 is broken")
    assert spoken.lines[6:] == ["omnid: warning: frame 1000 is broken (and 995 more of this kind)"]
    spoken.journal.say(WARNING, "frame 1001 is broken")
    assert spoken.lines[7:] == ["omnid: warning: frame 1001 is broken"]


def test_what_ends_the_program_is_written_in_any_case(spoken: Spoken) -> None:
    for _ in range(20):
        spoken.journal.tell(ERROR, "no such\nfile")
    assert spoken.lines == ["omnid: no such file"] * 20


def test_the_command_line_says_why_it_ends_with_priority(pipe: tuple[int, int]) -> None:
    found = os.fstat(pipe[1])
    environment = os.environ | {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"}
    done = subprocess.run([sys.executable, "-m", "omnid", "config", "--config", "/nowhere"], cwd=ROOT, env=environment,
                          stderr=pipe[1])
    assert done.returncode == 2
    assert os.read(pipe[0], 1000).startswith(b"<3>cannot read the settings file '/nowhere'")


def test_at_the_end_what_was_held_back_is_told_once(spoken: Spoken) -> None:
    for _ in range(7):
        spoken.journal.say(WARNING, "camera 2 is dark")
    spoken.journal.flush()
    spoken.journal.flush()
    assert spoken.lines[5:] == ["omnid: 2 more of this kind: camera # is dark"]


def test_what_is_remembered_is_bounded(spoken: Spoken) -> None:
    letters = [chr(0x4E00 + number) for number in range(5000)]
    for letter in letters:
        spoken.journal.say(NOTICE, letter)
    assert len(spoken.lines) == 5000
    assert len(spoken.journal._kinds) == 256


@pytest.mark.parametrize(
    ("text", "line"),
    [("two\nlines", "two lines"), ("\x1b[31mred\x00\x07", "[31mred"), (" much   room ", "much room"), ("", ""),
     ("<0>panic", "<0>panic")],
)
def test_what_devices_call_themselves_makes_no_lines_of_its_own(spoken: Spoken, text: str, line: str) -> None:
    spoken.journal.say(NOTICE, text)
    assert spoken.lines == [f"omnid: {line}"]


def test_a_line_is_of_bounded_length(spoken: Spoken) -> None:
    spoken.journal.say(NOTICE, "x" * 10**6)
    assert len(spoken.lines[0]) == len("omnid: ") + 4000


def test_lines_of_many_threads_stay_whole_and_all_are_counted(spoken: Spoken) -> None:
    def speak(name: str) -> None:
        for _ in range(500):
            spoken.journal.say(NOTICE, name * 20)

    threads = [threading.Thread(target=speak, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(spoken.lines) == sorted(f"omnid: {name * 20}" for name in "abcd" for _ in range(5))
    assert spoken.journal.held_back == 4 * 495


def test_nobody_who_reads_is_no_error() -> None:
    closed = io.StringIO()
    closed.close()
    Journal(closed).say(ERROR, "into the void")
    with open("/dev/full", "wb", buffering=0) as full:
        assert said({}, full.fileno()) == 0


def test_what_libraries_log_has_its_priority(pipe: tuple[int, int]) -> None:
    found = os.fstat(pipe[1])
    environment = {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"}
    script = (
        "import logging, omnid.engine.logging_setup; log = logging.getLogger('library'); log.info('by the way')\n"
        "log.warning('careful, %d', 7); log.critical('broken')"
    )
    assert said(environment, pipe[1], script) == 0
    assert os.read(pipe[0], 1000) == b"<4>library: careful, 7\n<3>library: broken\n"
