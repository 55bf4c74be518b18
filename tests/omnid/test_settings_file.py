"""A settings file is a bounded table, or an error of one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from omnid.errors import OmnidError
from omnid.settings_file import bytes_of, read_table

LARGEST = 1 << 20


def test_the_table_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("robot = 'r2'\n[stereo]\nratio = 1")
    assert read_table(path) == {"robot": "r2", "stereo": {"ratio": 1}}


@pytest.mark.parametrize(("content", "found"), [(b"a =", "expected TOML, found"), (b"a = '\xff'", "at offset 5")])
def test_what_is_no_table_is_named_with_its_file(tmp_path: Path, content: bytes, found: str) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(content)
    with pytest.raises(OmnidError, match=f"^{path}: .*{found}"):
        read_table(path)


def test_a_file_is_read_up_to_its_largest_size(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(b"#" * LARGEST)
    assert len(bytes_of(path)) == LARGEST
    path.write_bytes(b"#" * (LARGEST + 1))
    with pytest.raises(OmnidError, match="more than 1048576 bytes"):
        bytes_of(path)
