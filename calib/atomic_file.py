"""Files that are replaced at once, never written in part: a robot may be switched off at any time.

A file is written under a temporary name in its folder, synced and renamed. Where its name is a symbolic link, the file
that the link leads to is replaced, and the link stays.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from glob import escape
from pathlib import Path
from typing import Final

# The temporary file is new, and not a link that another program has made.
_NEW: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


@contextmanager
def replacement(path: Path) -> Iterator[Path]:
    """Yield an empty temporary file, which takes the place of the file at the end of the block, not after an error.

    A pipe or a device is no file to replace: it is yielded itself. Temporary files that killed programs have left for
    this file are removed. Raises OSError.
    """
    if path.exists() and not path.is_file():
        yield path
        return
    target = Path(os.path.realpath(path))
    for part in target.parent.glob(f".{escape(target.name)}.*.part"):
        process = part.name.split(".")[-2]
        if process.isdecimal() and not Path("/proc", process).exists():
            part.unlink(missing_ok=True)
    # On the same file system, so that the rename is atomic.
    partial = target.with_name(f".{target.name}.{os.getpid()}.part")
    partial.unlink(missing_ok=True)
    os.close(os.open(partial, _NEW, 0o666))
    try:
        yield partial
        _sync(partial)
        os.replace(partial, target)
        _sync(target.parent)
    finally:
        partial.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
