"""Sizes of files are bounded."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.errors import CalibError
from calib.text_files import decode
from calib.validation import read_bytes


def test_files_are_bounded(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", 5) == b"12345"
    with pytest.raises(CalibError, match="more than 4 bytes"):
        read_bytes(tmp_path / "a", 4)
    with pytest.raises(CalibError, match="cannot be read: No such file"):
        read_bytes(tmp_path / "b")
    with pytest.raises(CalibError, match=r"expected UTF-8 text, found byte .*at 1"):
        decode(b"\0\xff", "f")
