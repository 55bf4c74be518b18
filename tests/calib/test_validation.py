"""Sizes of files and images, rigid transforms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.validation import MAX_SIDE_PX, decode, is_image_size, read_bytes, rigid, transform_of


def test_a_transform_is_rigid_and_its_rotation_is_made_orthonormal() -> None:
    T = se3.transform(se3.rotation_exp([0.1, 0.2, 0.3]), [1, 2, 3])
    assert rigid(T) is T
    rounded = transform_of(T.round(5).tolist(), "T")
    assert np.abs(rounded[:3, :3] @ rounded[:3, :3].T - np.eye(3)).max() < 1e-12 and np.allclose(rounded, T, atol=1e-4)
    for wrong in (np.eye(4) * 2, np.diag([1.0, 1, -1, 1]), np.eye(3)):
        with pytest.raises(CalibError, match=r"T: expected (a rotation|4 rows)"):
            transform_of(wrong.tolist(), "T")


def test_sizes_of_images_are_bounded() -> None:
    assert is_image_size(1, MAX_SIDE_PX) and not is_image_size(0, 10)
    assert not is_image_size(1, MAX_SIDE_PX + 1) and not is_image_size(9000, 9000)


def test_files_are_bounded(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", 5) == b"12345"
    with pytest.raises(CalibError, match="more than 4 bytes"):
        read_bytes(tmp_path / "a", 4)
    with pytest.raises(CalibError, match="cannot be read: No such file"):
        read_bytes(tmp_path / "b")
    with pytest.raises(CalibError, match="expected UTF-8 text, found byte 255 at 0"):
        decode(b"\xff", "f")
