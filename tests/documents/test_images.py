"""The images of README and docs can be made again."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.documents import images


def test_the_stills_show_one_pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(images, "FOLDER", tmp_path)
    images.stills()
    mirror, panorama, depth = (cv2.imread(str(tmp_path / name)) for name in ("mirror.jpg", "panorama.jpg", "depth.jpg"))
    assert mirror is not None and panorama is not None and depth is not None
    assert mirror.shape[0] == mirror.shape[1] and panorama.shape == depth.shape
    colored = np.ptp(depth.astype(int), axis=2) > 60  # a located pixel has a colour
    assert 0.03 < colored.mean() < 0.6


@pytest.mark.slow
def test_the_drive_becomes_a_moving_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pillow = pytest.importorskip("PIL.Image")
    monkeypatch.setattr(images, "FOLDER", tmp_path)
    images.drive(seconds=3.0)
    with pillow.open(tmp_path / "drive.gif") as image:
        assert image.n_frames >= 3 and image.width == images.GIF_WIDTH_PX
