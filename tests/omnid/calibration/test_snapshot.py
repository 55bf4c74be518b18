"""`omnid cameras --snapshot` on the images of a log: the rim, and measures that follow focus and light."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.frame import gray
from drivers.logs.log_reader import LogReader
from omnid.calibration.snapshot import Image, described, view_of
from tests.replay.command import Command


@pytest.fixture(scope="module")
def images(scene: Path) -> dict[str, list[Image]]:
    """The images of both cameras."""
    reader = LogReader(scene / "log.mcap")
    found: dict[str, list[Image]] = {"lower": [], "upper": []}
    for frame in reader.frames():
        found[frame.camera].append(gray(frame))
    reader.close()
    return found


def test_the_command_writes_both_images(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = Command(capsys)("cameras", "--snapshot", tmp_path / "views", "--log", scene / "log.mcap")
    assert (code, err) == (0, "") and out.count("rim: centre (12") == 2
    for name in ("lower", "upper"):
        image = cv2.imread(str(tmp_path / "views" / f"{name}.png"))
        assert image is not None and image.shape == (256, 256, 3)
        assert (image[:, :, 1].astype(int) - image[:, :, 0] > 60).sum() > 300, "the rim is drawn in green"


def test_focus_falls_with_blur_and_not_with_light(images: dict[str, list[Image]]) -> None:
    sharp = images["lower"][:5]
    blurred = [cv2.GaussianBlur(image, (0, 0), 1.5) for image in sharp]
    dim = [np.asarray(image // 2, np.uint8) for image in sharp]
    focus, worse, darker = (view_of(some).focus for some in (sharp, blurred, dim))
    assert worse < 0.35 * focus and darker == pytest.approx(focus, rel=0.15)
    assert "no rim found" in described(view_of([np.zeros((200, 200), np.uint8)]))


def test_wrong_input(tmp_path: Path, scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    omnid = Command(capsys)
    assert "a folder that can be made" in omnid.refused("cameras", "--snapshot", "/dev/null/a")
    device = f"cameras.lower={tmp_path / 'none'}"
    assert "is not there" in omnid.refused("cameras", "--snapshot", tmp_path, "--set", device)
    empty = tmp_path / "empty.mcap"
    shutil.copy(scene / "rig.toml", empty)
    assert str(empty) in omnid.refused("cameras", "--snapshot", tmp_path, "--log", empty)
