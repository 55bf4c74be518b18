"""Advisory locks that mark a file as being written; the kernel releases them when the program ends."""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress
from pathlib import Path
from typing import IO


def lock(file: IO[bytes]) -> None:
    """Mark an open file as being written until it is closed; without effect where the file system has no locks."""
    with suppress(OSError):
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_locked(path: str | os.PathLike[str]) -> bool:
    """True if a program, this one included, is writing the file; False where it cannot be opened."""
    if not Path(path).is_file():
        return False
    try:
        with open(path, "rb") as file:
            fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
