"""Logging of the programs: one line per record on stderr, with the priorities of journald where it reads them.

Modules log by `log(level, text)` or a logger of `logging`; a program calls `configure_logging` once. Lines that differ
in their numbers only are written a few times a minute and then counted: a fault that repeats at the rate of the images
does not fill the disk.
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
from typing import Final, TextIO, TypeAlias

from omnid.plain_text import one_line

LOGGER: Final = logging.getLogger("omnid")

Report: TypeAlias = Callable[[int, str], None]  # level of `logging` and one line

# Levels of logging and the priorities of syslog and journald (RFC 5424, section 6.2.1).
_PRIORITIES: Final = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
_DEBUG_PRIORITY: Final = 7

_BURST: Final = 5  # Most lines of a kind that are written within a period.
_PERIOD_S: Final = 60.0
_MAX_KINDS: Final = 256  # Most kinds of lines whose counts are kept; the kind not seen for longest is dropped.
_COLUMNS: Final = 80  # Used for a terminal that does not report its size.
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


@dataclass(slots=True)
class _Kind:
    """Count of the lines that differ in their numbers only."""

    since_s: float
    written: int = 0
    suppressed: int = 0  # since the last line written


class StderrHandler(logging.Handler):
    """Writes records as single lines with a rate limit per kind of line."""

    def __init__(self, stream: TextIO | None = None, clock_s: Callable[[], float] = time.monotonic) -> None:
        """stream: None for sys.stderr at the time of writing."""
        super().__init__()
        self._stream, self._clock_s = stream, clock_s
        self._kinds: dict[str, _Kind] = {}  # by the line without its numbers; the kind seen last is the last one
        self._shown = ""  # line that is shown below the others on a terminal
        self.suppressed = 0  # lines in all

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record, unless too many of its kind were written within the period."""
        text = record.getMessage()
        if record.name != LOGGER.name:
            text = f"{record.name}: {text}"
        line = one_line(text, _MAX_LENGTH)
        if getattr(record, "unlimited", False):
            self._write(record.levelno, line)
        else:
            self._write_limited(record.levelno, line)

    def show(self, line: str) -> None:
        """Keep a line below the others of a terminal until it is replaced; "" removes it."""
        self.acquire()
        try:
            stream = self._stream or sys.stderr
            with suppress(OSError, ValueError):
                columns = os.get_terminal_size(stream.fileno()).columns or _COLUMNS
                # A longer line would fill a second row, which _ERASE does not reach.
                self._shown = _fitting(one_line(line, _MAX_LENGTH), max(0, columns - 1))
                stream.write(f"{_ERASE}{self._shown}")
                stream.flush()
        finally:
            self.release()

    def flush(self) -> None:
        """Report how many lines of each kind were suppressed; `logging` calls this at the end of the program."""
        self.acquire()
        try:
            for key, kind in self._kinds.items():
                if kind.suppressed:
                    self._write(logging.INFO, f"{kind.suppressed} more of this kind: {key}")
                    kind.suppressed = 0
        finally:
            self.release()

    def _write_limited(self, level: int, line: str) -> None:
        kind = self._kind(_NUMBER.sub("#", line), self._clock_s())
        if kind.written == _BURST:
            kind.suppressed += 1
            self.suppressed += 1
            return
        self._write(level, f"{line} (and {kind.suppressed} more of this kind)" if kind.suppressed else line)
        kind.written, kind.suppressed = kind.written + 1, 0

    def _kind(self, key: str, now_s: float) -> _Kind:
        """Return the count of a kind of lines, within the present period."""
        kind = self._kinds.pop(key, None) or _Kind(now_s)
        if now_s - kind.since_s > _PERIOD_S:
            kind.since_s, kind.written = now_s, 0
        self._kinds[key] = kind
        if len(self._kinds) > _MAX_KINDS:
            del self._kinds[next(iter(self._kinds))]
        return kind

    def _write(self, level: int, line: str) -> None:
        stream = self._stream or sys.stderr
        prefix = f"<{priority(level)}>" if is_journal(stream) else f"omnid: {_label(level)}"
        with suppress(OSError, ValueError):  # a closed stream or a full disk must not end the program
            erase = _ERASE if self._shown else ""
            stream.write(f"{erase}{prefix}{line}\n{self._shown}")
            stream.flush()


def priority(level: int) -> int:
    """Return the priority of syslog and journald for a level of `logging`."""
    return next((number for least, number in _PRIORITIES if level >= least), _DEBUG_PRIORITY)


def _fitting(line: str, columns: int) -> str:
    """Return a line, without its last parts where they do not fit."""
    if len(line) <= columns:
        return line
    return line[: columns + 1].rpartition(", ")[0] or line[:columns]


def _label(level: int) -> str:
    return "warning: " if level == logging.WARNING else ""


def is_journal(stream: TextIO) -> bool:
    """True if journald reads the stream: $JOURNAL_STREAM is then its device and inode (systemd.exec(5))."""
    expected = os.environ.get("JOURNAL_STREAM")
    try:
        found = os.fstat(stream.fileno()) if expected else None
    except (OSError, ValueError):  # no file descriptor
        return False
    return found is not None and expected == f"{found.st_dev}:{found.st_ino}"


HANDLER: Final = StderrHandler()
