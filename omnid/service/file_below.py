"""Files of a system below a folder: no symbolic link is followed there, so nothing is written elsewhere.

This runs as root, and DIR of `--root DIR` may hold a system from another source.
"""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Final

from omnid.errors import OmnidError

_FOLDER: Final = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_NEW: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_MODE: Final = 0o644


def text_below(root: Path, name: str) -> str | None:
    """Return the text of root/name, None where there is none; raise OmnidError for a link, a folder or a device."""
    folder = root
    for part in PurePosixPath(name).parts:
        folder /= part
        if folder.is_symlink():
            raise OmnidError(_link(folder))
    if not folder.exists():
        return None
    if not folder.is_file():
        raise OmnidError(f"{folder} is no regular file: remove it, or name another --root")
    return folder.read_text("utf-8", "replace")


def write_below(root: Path, name: str, text: str) -> None:
    """Write root/name whole, in folders that are made where they are missing; raise OmnidError where that fails."""
    path, folder = root / name, -1
    *above, last = PurePosixPath(name).parts
    try:
        root.mkdir(parents=True, exist_ok=True)
        folder = os.open(root, _FOLDER & ~os.O_NOFOLLOW)
        for part in above:
            with suppress(FileExistsError):
                os.mkdir(part, dir_fd=folder)
            inner = os.open(part, _FOLDER, dir_fd=folder)
            os.close(folder)
            folder = inner
        _replace(folder, last, text)
    except OSError as error:
        # A link in the place of a folder: ENOTDIR on Linux, ELOOP elsewhere.
        if error.errno in (errno.ENOTDIR, errno.ELOOP) and any(one.is_symlink() for one in (path, *path.parents)):
            raise OmnidError(_link(path)) from error
        raise OmnidError(
            f"{path} cannot be written: {error.strerror}; run this command with sudo, or name another --root"
        ) from error
    finally:
        if folder >= 0:
            os.close(folder)


def _replace(folder: int, name: str, text: str) -> None:
    """Put a file in the place of one of that name in an open folder."""
    partial = f".{name}.{os.getpid()}.part"
    with suppress(FileNotFoundError):
        os.unlink(partial, dir_fd=folder)
    with open(os.open(partial, _NEW, _MODE, dir_fd=folder), "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fchmod(file.fileno(), _MODE)
        os.fsync(file.fileno())
    os.replace(partial, name, src_dir_fd=folder, dst_dir_fd=folder)


def _link(path: Path) -> str:
    return f"{path}: a symbolic link is in its place or above it: remove it, or name another --root"
