"""Output files that are replaced at once, never written in part."""

from __future__ import annotations

from pathlib import Path

from calib.atomic_file import replacement
from omnid.errors import OmnidError


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole. Raises OmnidError if that is impossible."""
    try:
        with replacement(path) as partial:
            partial.write_bytes(content)
    except (OSError, ValueError) as error:
        raise OmnidError(f"{path}: cannot write the file: {error}: choose another file") from error
