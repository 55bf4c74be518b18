"""Files that are replaced at once, never written in part: a robot may be switched off at any time."""

from __future__ import annotations

import os
from pathlib import Path

from omnid.errors import OmnidError


def write_whole(path: Path, content: bytes) -> None:
    """Write a file under a temporary name beside it, sync it and rename it. Raises OmnidError if that is impossible."""
    try:
        # On the same file system, so that the rename is atomic.
        partial = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            with partial.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
    except (OSError, ValueError) as error:
        raise OmnidError(f"{path}: cannot write the file: {error}: choose another file") from error
