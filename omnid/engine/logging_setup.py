"""Logging of the programs: one line per record on stderr, with the priorities of journald where it reads them.

Modules log by `log(level, text)` or a logger of `logging`; a program calls `configure_logging` once. Of lines that
differ in their numbers only, a few a minute are written: a fault that repeats at the rate of the images does not fill
the disk.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Final, TextIO, TypeAlias

from omnid.plain_text import one_line

LOGGER: Final = logging.getLogger("omnid")

Report: TypeAlias = Callable[[int, str], None]  # level of `logging` and one line

# Levels of logging and the priorities of syslog and journald (RFC 5424, section 6.2.1).
_PRIORITIES: Final = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (0, 7))
_BURST: Final = 5  # Most lines of a kind that are written within a period.
_PERIOD_S: Final = 60.0
_MAX_KINDS: Final = 256  # Most kinds of lines that are counted; the counts then begin again.
_ERASE: Final = "\r\x1b[K"  # Erases the line of a terminal that the cursor is in.
_MAX_LENGTH: Final = 4000  # Most characters of a line.
_NUMBER = re.compile(r"\d+")


def log(level: int, text: str) -> None:
    """Log a line, rate limited; level as in `logging`. For any thread, not for signal handlers."""
    LOGGER.log(level, "%s", text)


def log_unlimited(level: int, text: str) -> None:
    """Log a line without rate limit: for messages that a program gives once, such as why it ends."""
    LOGGER.log(level, "%s", text, extra={"unlimited": True})


def configure_logging() -> None:
    """Write the records of omnid from INFO on, and of libraries from WARNING on, to stderr; may be called again."""
    root = logging.getLogger()
    if HANDLER not in root.handlers:
        root.addHandler(HANDLER)
    LOGGER.setLevel(logging.INFO)


class StderrHandler(logging.Handler):
    """Writes records as single lines with a rate limit per kind of line."""

    def __init__(self, stream: TextIO | None = None, clock_s: Callable[[], float] = time.monotonic) -> None:
        """stream: None for sys.stderr at the time of writing."""
        super().__init__()
        self._stream, self._clock_s = stream, clock_s
        self._kinds: Counter[str] = Counter()  # lines of this period, by the line without its numbers
        self._since_s = -_PERIOD_S
        self._suppressed = 0  # lines in this period
        self._shown = ""  # line that is shown below the others on a terminal

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record, unless too many of its kind were written within the period."""
        name = "" if record.name == LOGGER.name else f"{record.name}: "
        line = one_line(f"{name}{record.getMessage()}", _MAX_LENGTH)
        if getattr(record, "unlimited", False) or self._passes(_NUMBER.sub("#", line)):
            self._write(record.levelno, line)

    def show(self, line: str) -> None:
        """Keep a line below the others of a terminal until it is replaced; "" removes it."""
        self.acquire()
        try:
            stream = self._stream or sys.stderr
            with suppress(OSError, ValueError):  # it is no terminal
                columns = os.get_terminal_size(stream.fileno()).columns or 80  # 0: unknown
                # A longer line would fill a second row, which _ERASE does not reach.
                self._shown = one_line(line, _MAX_LENGTH)[: max(0, columns - 1)]
                stream.write(f"{_ERASE}{self._shown}")
                stream.flush()
        finally:
            self.release()

    def flush(self) -> None:
        """Report how many lines were left out; `logging` calls this at the end of the program."""
        self.acquire()
        try:
            if self._suppressed:
                self._write(logging.INFO, f"{self._suppressed} more lines like the last ones were left out")
                self._suppressed = 0
        finally:
            self.release()

    def _passes(self, kind: str) -> bool:
        now_s = self._clock_s()
        if now_s - self._since_s > _PERIOD_S or len(self._kinds) >= _MAX_KINDS:
            self.flush()
            self._since_s = now_s
            self._kinds.clear()
        self._kinds[kind] += 1
        self._suppressed += self._kinds[kind] > _BURST
        return self._kinds[kind] <= _BURST

    def _write(self, level: int, line: str) -> None:
        stream = self._stream or sys.stderr
        if is_journal(stream):
            prefix = f"<{priority(level)}>"
        else:
            prefix = "omnid: warning: " if level == logging.WARNING else "omnid: "
        with suppress(OSError, ValueError):  # a closed stream or a full disk must not end the program
            erase = _ERASE if self._shown else ""
            stream.write(f"{erase}{prefix}{line}\n{self._shown}")
            stream.flush()


def priority(level: int) -> int:
    """Return the priority of syslog and journald for a level of `logging`."""
    return next(number for least, number in _PRIORITIES if level >= least)


def is_journal(stream: TextIO) -> bool:
    """True if journald reads the stream: $JOURNAL_STREAM is then its device and inode (systemd.exec(5))."""
    expected = os.environ.get("JOURNAL_STREAM")
    try:
        found = os.fstat(stream.fileno()) if expected else None
    except (OSError, ValueError):  # no file descriptor
        return False
    return found is not None and expected == f"{found.st_dev}:{found.st_ino}"


HANDLER: Final = StderrHandler()
