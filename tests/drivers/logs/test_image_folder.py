"""Folders of images with stamps, one folder for each camera."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.errors import DriverError
from drivers.frame import gray
from drivers.logs.image_folder import ImageFolder, parse_stamp
from drivers.logs.image_log import images_of
from drivers.logs.log_reader import LogReader
from tests.drivers.logs.foreign_logs import PAIRS, expected, read, write_folders
from tests.drivers.logs.mcap_logs import pairs


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


@pytest.mark.parametrize("names", [str, lambda stamp: f"{stamp // 10**9}.{stamp % 10**9:09d}"])
def test_folders_of_images_with_stamps(tmp_path: Path, names: Callable[[int], str]) -> None:
    folder = write_folders(tmp_path / "images", pairs(PAIRS), names)
    (folder / "rig.toml").write_text("[rig]")
    found, reader = read(folder)
    assert found == expected(tmp_path) and not reader.warnings
    with closing(LogReader(folder)) as again:
        assert again.attachments() == {"rig.toml": b"[rig]"} and again.pair_estimate() == PAIRS


def test_folders_with_a_list_of_stamps(tmp_path: Path) -> None:
    numbers = {entry.log_time_ns: index // 2 for index, entry in enumerate(pairs(PAIRS))}
    folder = write_folders(tmp_path / "images", pairs(PAIRS), lambda stamp: f"{numbers[stamp]:010d}")
    for camera in ("lower", "upper"):
        stamps = [frame[2] for frame in expected(tmp_path) if frame[0] == camera]
        lines = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in stamps]
        (folder / camera / "timestamps.txt").write_text("\n".join(lines) + "\n")
    assert read(folder)[0] == expected(tmp_path)
    for path in folder.glob("*/*.jpg"):  # 10 comes after 9, not after 1
        path.rename(path.with_stem(str(int(path.stem))))
    assert read(folder)[0] == expected(tmp_path)
    kept = (folder / "upper" / "timestamps.txt").read_text()
    for name in ("0000000007", "7"):  # without the list it would be taken for 7 s
        (folder / "upper" / "timestamps.txt").unlink(missing_ok=True)
        with pytest.raises(DriverError, match=r"upper' are numbered, .*timestamps.txt"):
            LogReader(folder)
        for path in (folder / "upper").glob("*.jpg"):
            path.rename(path.with_stem(f"{int(path.stem):0{len(name)}d}"))
    (folder / "upper" / "timestamps.txt").write_text(kept)
    assert read(folder)[0] == expected(tmp_path)
    (folder / "upper" / "timestamps.txt").write_text("1.0\n")
    with pytest.raises(DriverError, match="12 images, and its list of stamps 1 lines"):
        LogReader(folder)


def test_cameras_of_folders_with_other_names_are_given(tmp_path: Path) -> None:
    folder = write_folders(tmp_path / "images", pairs(PAIRS))
    for camera, name in (("lower", "cam0"), ("upper", "cam1")):
        (folder / "mav0" / name).mkdir(parents=True)
        (folder / camera).rename(folder / "mav0" / name / "data")
    with pytest.raises(DriverError, match="mav0/cam0/data, mav0/cam1/data; give --lower and --upper"):
        LogReader(folder)
    assert read(folder, lower="mav0/cam0/data", upper="mav0/cam1/data")[0] == expected(tmp_path)


@pytest.mark.parametrize(
    ("step", "apart"),
    [(100_000_000, "3.2 years"), (10_000, "2.8 hours"), (100_000, "27.8 hours"), (1_000_000, "12 days")],
)
def test_images_hours_apart_are_a_question(tmp_path: Path, step: int, apart: str) -> None:
    """Names of 10 digits that count nanoseconds or so would be seconds; one line says so, names the images and asks."""
    numbers = {entry.log_time_ns: index // 2 for index, entry in enumerate(pairs(PAIRS))}
    folder = write_folders(tmp_path / "images", pairs(PAIRS), lambda stamp: f"{step * numbers[stamp]:010d}")
    with pytest.raises(DriverError, match=f"0000000000.* are {apart} apart .*fewer than 16 digits are seconds"):
        LogReader(folder)


@pytest.mark.parametrize(("step_us", "apart"), [(33_333, "33.333"), (100_000, "100"), (1_000_000, "1000")])
def test_images_named_by_microseconds_are_not_taken_for_nanoseconds(tmp_path: Path, step_us: int, apart: str) -> None:
    """30, 10 and one image a second: as nanoseconds they are taken 1,000 times too fast."""
    numbers = {entry.log_time_ns: index // 2 for index, entry in enumerate(pairs(PAIRS))}
    folder = write_folders(
        tmp_path / "images", pairs(PAIRS), lambda stamp: str(1_418_381_798_086_398 + step_us * numbers[stamp])
    )
    with pytest.raises(DriverError, match=rf"1418381798086398.* are {re.escape(apart)} us apart .*microseconds"):
        LogReader(folder)


def test_images_less_than_an_hour_apart_are_a_log(tmp_path: Path) -> None:
    numbers = {entry.log_time_ns: index // 2 for index, entry in enumerate(pairs(PAIRS))}
    folder = write_folders(tmp_path / "images", pairs(PAIRS), lambda stamp: f"{3600 * numbers[stamp]:010d}")
    assert len(read(folder)[0]) == 2 * PAIRS


def test_an_image_without_stamp_is_refused(tmp_path: Path) -> None:
    folder = write_folders(tmp_path / "images", pairs(1), lambda stamp: f"frame{stamp % 100}")
    with pytest.raises(DriverError, match=r"is named 'frame0'; expected a stamp.* timestamps\.txt"):
        LogReader(folder)


@pytest.mark.parametrize("kind", ["pipe", "device", "link", "folder"])
@pytest.mark.parametrize("name", ["lower/1700000000000000001.jpg", "rig.toml"])
def test_folders_hold_regular_files_only(tmp_path: Path, kind: str, name: str) -> None:
    """Anything else is one line, and nothing waits for a pipe; a rig that is none is left out."""
    folder, odd = write_folders(tmp_path / "images", pairs(2)), tmp_path / "images" / name
    (tmp_path / "secret").write_text("secret")
    if kind == "pipe":
        os.mkfifo(odd)
    elif kind == "folder":
        odd.mkdir()
    else:
        odd.symlink_to("/dev/zero" if kind == "device" else tmp_path / "secret")
    if name == "rig.toml":
        with closing(LogReader(folder)) as reader:
            assert reader.attachments() == {}
        return
    with pytest.raises(DriverError, match=r"1700000000000000001.jpg': no regular file of the folder") as refused:
        LogReader(folder)
    assert "\n" not in str(refused.value)


def test_a_link_within_the_folder_is_an_image_and_a_pipe_that_comes_later_is_not_waited_for(tmp_path: Path) -> None:
    folder = write_folders(tmp_path / "images", pairs(3))
    first, last = (sorted((folder / "lower").iterdir())[number] for number in (0, -1))
    (folder / "kept").mkdir()
    first.rename(folder / "kept" / "image")
    first.symlink_to(folder / "kept" / "image")
    with closing(LogReader(folder)) as reader:
        last.unlink()
        os.mkfifo(last)
        assert len(list(reader.frames())) == 5 and reader.counts["broken"] + reader.counts["broken_records"] == 1
