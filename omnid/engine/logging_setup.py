"""Logging of the programs: one line per record on stderr, with the priorities of journald where it reads them.

Modules log by `log(level, text)` or a logger of `logging`; a program calls `configure_logging` once. journald bounds
what a fault that repeats can write.
"""

from __future__ import annotations

import logging
import os
import sys
from contextlib import suppress
from typing import Final, TextIO

from omnid.plain_text import one_line

LOGGER: Final = logging.getLogger("omnid")

_ERASE: Final = "\r\x1b[K"  # Erases the line of a terminal that the cursor is in.


def log(level: int, text: str) -> None:
    """Log a line; level as in `logging`. For any thread, not for signal handlers."""
    LOGGER.log(level, "%s", text)


def configure_logging() -> None:
    """Write the records of omnid from INFO on, and of libraries from WARNING on, to stderr; may be called again."""
    logging.getLogger().addHandler(HANDLER)
    LOGGER.setLevel(logging.INFO)


class StderrHandler(logging.Handler):
    """Writes records as single lines, above a line that a terminal keeps showing."""

    _status = ""  # line that is kept below the others on a terminal

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record."""
        name = "" if record.name == LOGGER.name else f"{record.name}: "
        prefix = "omnid: warning: " if record.levelno == logging.WARNING else "omnid: "
        if is_journal(sys.stderr):  # priorities of syslog and journald (RFC 5424, section 6.2.1)
            prefix = f"<{ {logging.CRITICAL: 2, logging.ERROR: 3, logging.WARNING: 4}.get(record.levelno, 6) }>"
        self._write(f"{_ERASE if self._status else ''}{prefix}{one_line(name + record.getMessage(), 4000)}\n")

    def show(self, line: str) -> None:
        """Keep a line below the others of a terminal until it is replaced; "" removes it."""
        with suppress(OSError, ValueError):  # stderr is no terminal
            columns = os.get_terminal_size(sys.stderr.fileno()).columns or 80  # 0: unknown
            # A longer line would fill a second row, which _ERASE does not reach.
            self._status = one_line(line, columns - 1)
            self._write(_ERASE)

    def _write(self, text: str) -> None:
        with suppress(OSError, ValueError):  # a closed stream or a full disk must not end the program
            sys.stderr.write(text + self._status)
            sys.stderr.flush()


def is_journal(stream: TextIO) -> bool:
    """True if journald reads the stream: $JOURNAL_STREAM is then its device and inode (systemd.exec(5))."""
    with suppress(OSError, ValueError):  # no file descriptor
        found = os.fstat(stream.fileno())
        return os.environ.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}"
    return False


HANDLER: Final = StderrHandler()
