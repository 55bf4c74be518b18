"""Logging of the programs: one line per record on stderr, with the priorities of journald where it reads them.

Modules log by `log(level, text)` or a logger of `logging`; a program calls `configure_logging` once. journald bounds
what a fault that repeats can write.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Final, TextIO, TypeAlias

from omnid.plain_text import one_line

LOGGER: Final = logging.getLogger("omnid")

Report: TypeAlias = Callable[[int, str], None]  # level of `logging` and one line

# Levels of logging and the priorities of syslog and journald (RFC 5424, section 6.2.1).
_PRIORITIES: Final = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (0, 7))
_ERASE: Final = "\r\x1b[K"  # Erases the line of a terminal that the cursor is in.
_MAX_LENGTH: Final = 4000  # Most characters of a line.


def log(level: int, text: str) -> None:
    """Log a line; level as in `logging`. For any thread, not for signal handlers."""
    LOGGER.log(level, "%s", text)


def configure_logging() -> None:
    """Write the records of omnid from INFO on, and of libraries from WARNING on, to stderr; may be called again."""
    root = logging.getLogger()
    if HANDLER not in root.handlers:
        root.addHandler(HANDLER)
    LOGGER.setLevel(logging.INFO)


class StderrHandler(logging.Handler):
    """Writes records as single lines, above a line that a terminal keeps showing."""

    def __init__(self, stream: TextIO | None = None) -> None:
        """stream: None for sys.stderr at the time of writing."""
        super().__init__()
        self._stream = stream
        self._shown = ""  # line that is shown below the others on a terminal

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record."""
        name = "" if record.name == LOGGER.name else f"{record.name}: "
        line = one_line(f"{name}{record.getMessage()}", _MAX_LENGTH)
        stream = self._stream or sys.stderr
        if is_journal(stream):
            priority = next(number for least, number in _PRIORITIES if record.levelno >= least)
            prefix = f"<{priority}>"
        else:
            prefix = "omnid: warning: " if record.levelno == logging.WARNING else "omnid: "
        with suppress(OSError, ValueError):  # a closed stream or a full disk must not end the program
            erase = _ERASE if self._shown else ""
            stream.write(f"{erase}{prefix}{line}\n{self._shown}")
            stream.flush()

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


def is_journal(stream: TextIO) -> bool:
    """True if journald reads the stream: $JOURNAL_STREAM is then its device and inode (systemd.exec(5))."""
    expected = os.environ.get("JOURNAL_STREAM")
    try:
        found = os.fstat(stream.fileno()) if expected else None
    except (OSError, ValueError):  # no file descriptor
        return False
    return found is not None and expected == f"{found.st_dev}:{found.st_ino}"


HANDLER: Final = StderrHandler()
