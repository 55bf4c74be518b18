"""What the daemon says: a line each on stderr, with the journal's priorities where the journal reads it.

The same line again and again is written a few times a minute, and the rest is counted: a fault that repeats itself at
the rate of the images fills no disk.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, TextIO

ERROR: Final = 3  # the numbers of syslog and journald (RFC 5424), as the drivers' reports have them
WARNING: Final = 4
NOTICE: Final = 5

_BURST: Final = 5  # lines of a kind that are written within a period
_PERIOD_S: Final = 60.0
_KINDS: Final = 256  # of which is known when they were last written
_LONGEST: Final = 4000  # characters of a line
_NUMBER = re.compile(r"\d+")


@dataclass(slots=True)
class _Kind:
    """Lines that differ in nothing but their numbers."""

    since_s: float
    written: int = 0
    held_back: int = 0  # since the last that was written


class Journal(logging.Handler):
    """Writes lines; any thread may, but no signal handler. What libraries log comes here too, from warnings on."""

    def __init__(self, stream: TextIO | None = None, clock_s: Callable[[], float] = time.monotonic) -> None:
        """stream: where to, else what sys.stderr is at the time."""
        super().__init__(logging.WARNING)
        self._stream, self._clock_s = stream, clock_s
        self._kinds: dict[str, _Kind] = {}  # the one that was spoken of last comes last
        self.held_back = 0  # lines in all

    def say(self, priority: int, text: str) -> None:
        """Writes the text as one line, unless too many have been that differ in nothing but their numbers."""
        self.acquire()
        try:
            self._judge(priority, _one_line(text))
        finally:
            self.release()

    def tell(self, priority: int, text: str) -> None:
        """Writes the text as one line, whatever has been said."""
        self.acquire()
        try:
            self._write(priority, _one_line(text))
        finally:
            self.release()

    def emit(self, record: logging.LogRecord) -> None:
        """Says a record of `logging`."""
        self.say(ERROR if record.levelno >= logging.ERROR else WARNING, f"{record.name}: {record.getMessage()}")

    def flush(self) -> None:
        """Tells how much of each kind has been held back; `logging` calls this at the end of the program."""
        self.acquire()
        try:
            for key, kind in self._kinds.items():
                if kind.held_back:
                    self._write(NOTICE, f"{kind.held_back} more of this kind: {key}")
                    kind.held_back = 0
        finally:
            self.release()

    def _judge(self, priority: int, line: str) -> None:
        kind = self._kind(_NUMBER.sub("#", line), self._clock_s())
        if kind.written == _BURST:
            kind.held_back += 1
            self.held_back += 1
            return
        self._write(priority, f"{line} (and {kind.held_back} more of this kind)" if kind.held_back else line)
        kind.written, kind.held_back = kind.written + 1, 0

    def _kind(self, key: str, now_s: float) -> _Kind:
        kind = self._kinds.pop(key, None) or _Kind(now_s)
        if now_s - kind.since_s > _PERIOD_S:
            kind.since_s, kind.written = now_s, 0
        self._kinds[key] = kind
        if len(self._kinds) > _KINDS:
            del self._kinds[next(iter(self._kinds))]
        return kind

    def _write(self, priority: int, line: str) -> None:
        stream = self._stream or sys.stderr
        with suppress(OSError, ValueError):  # nobody reads it any more: no reason to end anything
            stream.write(f"<{priority}>{line}\n" if _is_journal(stream) else f"omnid: {_word(priority)}{line}\n")
            stream.flush()


def _one_line(text: str) -> str:
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text[:_LONGEST]).split())


def _word(priority: int) -> str:
    return "warning: " if priority == WARNING else ""


def _is_journal(stream: TextIO) -> bool:
    """Whether journald reads the stream, which it says by its device and inode (systemd.exec(5), $JOURNAL_STREAM)."""
    told = os.environ.get("JOURNAL_STREAM")
    try:
        found = os.fstat(stream.fileno()) if told else None
    except (OSError, ValueError):  # it has no number
        return False
    return found is not None and told == f"{found.st_dev}:{found.st_ino}"


JOURNAL: Final = Journal()
say: Final = JOURNAL.say
tell: Final = JOURNAL.tell
logging.lastResort = JOURNAL
