"""The transform between two cameras, from a file or from a measured baseline."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.transform_file import read_transform

T_LOWER_UPPER = se3.exp([0.02, -0.01, -0.2, 0.02, 0.05, 0.3])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("t.toml", f"T_lower_upper = {T_LOWER_UPPER.tolist()}"),
        ("t.toml", f"T_upper_lower = {se3.inverse(T_LOWER_UPPER).tolist()}"),
        ("t.yaml", f"T_lower_upper: {T_LOWER_UPPER.tolist()}"),
        ("t.txt", "# rows\n" + "\n".join(" ".join(map(repr, map(float, row))) for row in T_LOWER_UPPER)),
        ("t.csv", ",".join(map(repr, map(float, T_LOWER_UPPER.ravel())))),
    ],
)
def test_reads_a_transform_in_every_format(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    np.testing.assert_allclose(read_transform(tmp_path / name), T_LOWER_UPPER, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("t.toml", "T_x = 3", "T_x: unknown key"),
        ("t.toml", "", "expected either T_lower_upper or T_upper_lower"),
        ("t.toml", "[", "not a TOML file"),
        ("t.yml", "T_lower_upper: 3", "4 rows of 4 numbers"),
        ("t.yml", "[", "YAML"),
        ("t.txt", "1 0 0 0", "4 rows"),
        ("t.txt", "one", "expected 16 numbers"),
        ("t.txt", "1 " * 16, "expected a rotation"),
        ("t.txt", "nan " * 16, "finite"),
    ],
)
def test_refuses_invalid_transform_files(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CalibError, match=message):
        read_transform(tmp_path / name)
