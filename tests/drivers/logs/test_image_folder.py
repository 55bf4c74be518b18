"""Folders of images with stamps, one folder for each camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.frame import gray
from drivers.logs.image_folder import ImageFolder, parse_stamp
from drivers.logs.image_log import images_of


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1403636579763555584", 1403636579763555584),
        ("1305031102.175304", 1305031102175304000),
        ("1305031102.1753041239", 1305031102175304123),
        ("7", 7_000_000_000),
        ("4611686018.427387903", 2**62 - 1),
        ("4611686018.427387904", None),
        ("1.036336e-01", 103_633_600),
        ("12_05_59", None),
        ("10_1", None),
        ("2011-09-26T13:02:25+02:00", 1317034945000000000),
        ("2011-09-26 13:02:25.951199337", 1317042145951199337),
        ("2011-09-26T13:02:25", 1317042145000000000),
        ("frame1", None),
        ("", None),
        ("-1", None),
        ("nan", None),
        ("1e30", None),
        ("9" * 400, None),
        ("1.2.3", None),
        ("2011-09-26 13:02:25.x", None),
        ("1969-01-01", None),
    ],
)
def test_stamps_are_exact(text: str, stamp_ns: int | None) -> None:
    assert parse_stamp(text) == stamp_ns


def read_by_log(folder: Path) -> list[np.ndarray]:
    return [gray(image.read().frame()) for image in images_of(ImageFolder(folder, [folder / "lower"]))]


@pytest.mark.parametrize(("bits", "read_bits"), [(10, 10), (12, 12), (13, 16), (16, 16)])
def test_samples_of_ten_or_twelve_bits_in_files_of_sixteen_are_as_bright_as_those_of_eight(
    bits: int, read_bits: int, tmp_path: Path
) -> None:
    """All images of the camera are read alike, the dark one, too."""
    (tmp_path / "lower").mkdir()
    whole = np.linspace(0, 2**bits - 1, 48 * 64).reshape(48, 64).astype(np.uint16)
    images = [whole // 200, whole, whole[::-1]]
    for second, image in enumerate(images):
        cv2.imwrite(str(tmp_path / "lower" / f"{second}.5.png"), image)
    assert [image.tolist() for image in read_by_log(tmp_path)] == [(i >> (read_bits - 8)).tolist() for i in images]


def test_a_sample_beyond_the_bits_of_the_others_is_white(tmp_path: Path) -> None:
    """Of a long log 16 images are looked at."""
    (tmp_path / "lower").mkdir()
    for k in range(64):
        image = np.full((4, 4), 2048 if k == 1 else 1023, np.uint16)
        cv2.imwrite(str(tmp_path / "lower" / f"{k}.5.png"), image)
    assert {int(image.min()) for image in read_by_log(tmp_path)} == {255}


def test_a_colour_image_of_sixteen_bits_is_read_as_before(tmp_path: Path) -> None:
    (tmp_path / "lower").mkdir()
    image = np.random.default_rng(1).integers(0, 65536, (32, 32, 3)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "lower/1.5.png"), image)
    expected = cv2.imread(str(tmp_path / "lower/1.5.png"), cv2.IMREAD_GRAYSCALE)
    assert (read_by_log(tmp_path)[0] == expected).all()
