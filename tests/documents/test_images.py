"""The images of README and docs can be made again."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import fromstring

import cv2
import numpy as np
import pytest

from tests.documents import diagrams, images


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


@pytest.mark.parametrize("name", list(diagrams.DIAGRAMS))
def test_the_diagrams_are_as_their_tables(name: str) -> None:
    text = diagrams.diagram(name)
    assert (diagrams.FOLDER / f"{name}.svg").read_text() == text, "python -m tests.documents.diagrams"
    assert fromstring(text).tag.endswith("svg")
    assert f"docs/images/{name}.svg" in (diagrams.FOLDER.parents[1] / "ARCHITECTURE.md").read_text()
