"""Images for a calibration, as bright as they are meant and each of them once; `omnid cameras --snapshot`."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import omnid
from drivers.frame import gray
from drivers.logs.log_reader import LogCameras, LogReader
from omnid.calibration.images import read_pairs
from omnid.calibration.snapshot import Image, annotated, described, view_of


@pytest.mark.parametrize(("suffix", "bits"), [("png", 8), ("png", 10), ("tif", 12), ("pgm", 12), ("png", 16)])
def test_the_upper_eight_of_the_stated_bits_are_read(suffix: str, bits: int, tmp_path: Path) -> None:
    whole = np.linspace(0, 2**bits - 1, 48 * 64).reshape(48, 64).astype(np.uint8 if bits == 8 else np.uint16)
    for name, image in (("a", whole), ("b", whole // 100)):
        for side in ("lower", "upper"):
            cv2.imwrite(str(tmp_path / f"{side}_{name}.{suffix}"), image)
    lower, _ = read_pairs(tmp_path, LogCameras(bits=max(bits, 10))).sides
    assert (lower["a"] == whole >> (bits - 8)).all() and (lower["b"] == whole // 100 >> (bits - 8)).all()


def test_a_name_stands_for_one_image(tmp_path: Path) -> None:
    for name in ("lower_1.png", "upper_1.png", "lower_1.jpg"):
        cv2.imwrite(str(tmp_path / name), np.full((48, 64), 7, np.uint8))
    with pytest.raises(omnid.OmnidError, match=r"lower_1\.jpg and lower_1\.png have one name"):
        read_pairs(tmp_path)


# Snapshots: the rim, and measures that follow focus and light


@pytest.fixture(scope="module")
def images(scene: Path) -> dict[str, list[Image]]:
    """The images of both cameras."""
    reader = LogReader(scene / "log.mcap")
    found: dict[str, list[Image]] = {"lower": [], "upper": []}
    for frame in reader.frames():
        found[frame.camera].append(gray(frame))
    reader.close()
    return found


def test_a_snapshot_shows_the_rim(images: dict[str, list[Image]]) -> None:
    for found in images.values():
        view = view_of(found)
        assert "rim: centre (12" in described(view)
        image = annotated(view)
        assert image.shape == (256, 256, 3)
        assert (image[:, :, 1].astype(int) - image[:, :, 0] > 60).sum() > 300, "the rim is drawn in green"


def test_focus_falls_with_blur_and_not_with_light(images: dict[str, list[Image]]) -> None:
    sharp = images["lower"][:5]
    blurred = [cv2.GaussianBlur(image, (0, 0), 1.5) for image in sharp]
    dim = [np.asarray(image // 2, np.uint8) for image in sharp]
    focus, worse, darker = (view_of(some).focus for some in (sharp, blurred, dim))
    assert worse < 0.35 * focus and darker == pytest.approx(focus, rel=0.15)
    assert "no rim found" in described(view_of([np.zeros((200, 200), np.uint8)]))
