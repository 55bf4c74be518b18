"""Pseudo-terminals in the place of serial ports: when one has ended, its number is given to another program."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.errors import DriverError

MAJORS: Final = range(136, 144)  # device numbers of /dev/pts/N (Linux, Documentation/admin-guide/devices.txt)


@dataclass(frozen=True, slots=True)
class _Found:
    path: Path
    terminal: tuple[int, int, int]  # device, inode, time of its making [ns]: a reused number has a later one
    links: tuple[tuple[int, int, int], ...]  # the same of the links that lead to it


class TerminalCheck:
    """Remembers the pseudo-terminal behind the name of a port, so that one of another program is not opened for it.

    Other ports always pass: a device that is plugged in again keeps its name.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._known: _Found | None = None

    def require_same(self) -> None:
        """Call before each opening; raise DriverError if the name leads to another terminal by the same links."""
        found = _pseudo_terminal(Path(self._name))
        if found is None:
            return
        known = self._known
        if known is not None and found.terminal != known.terminal and found.links == known.links:
            raise DriverError(
                f"port {self._name!r}: the pseudo-terminal behind it has ended, and {found.path} belongs to another "
                "program now; start the first one again, and make a new link to its terminal or name that"
            )
        self._known = found


def _pseudo_terminal(path: Path) -> _Found | None:
    """Return the pseudo-terminal that a path leads to; None where it leads to none."""
    links: list[tuple[int, int, int]] = []
    try:
        end = path.stat()
        while path.is_symlink():
            links.append(_mark(path.lstat()))
            path = path.parent / path.readlink()
    except (OSError, ValueError):
        return None  # the opening reports why
    is_terminal = stat.S_ISCHR(end.st_mode) and os.major(end.st_rdev) in MAJORS
    return _Found(path, _mark(end), tuple(links)) if is_terminal else None


def _mark(entry: os.stat_result) -> tuple[int, int, int]:
    return entry.st_dev, entry.st_ino, entry.st_ctime_ns
