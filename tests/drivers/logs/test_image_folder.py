"""Folders of images with stamps, one folder for each camera."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Final

import pytest

from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from tests.drivers.logs.bags import write_folders
from tests.drivers.logs.mcap_logs import START_NS, pairs
from tests.drivers.logs.test_formats import PAIRS, expected, read

STEP_NS = 10**8
NUMBERS = {entry.log_time_ns: index // 2 for index, entry in enumerate(pairs(PAIRS))}


def stamps(folder: Path, **options: float) -> list[int]:
    """Return the stamps of the lower camera's images since the first one [ns]."""
    found = [frame[2] for frame in read(folder, **options)[0] if frame[0] == "lower"]
    return [stamp_ns - found[0] for stamp_ns in found]


def as_taken(count: int = PAIRS) -> list[int]:
    return [STEP_NS * number for number in range(count)]


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize(
    "name", [str, lambda stamp_ns: f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"], ids=["nanoseconds", "seconds"]
)
def test_names_are_nanoseconds_or_seconds_with_a_decimal_point(tmp_path: Path, suffix: str, name: object) -> None:
    folder = write_folders(tmp_path / "images", pairs(PAIRS), name, suffix)  # type: ignore[arg-type]
    found, reader = read(folder)
    assert [frame[:3] for frame in found] == [frame[:3] for frame in expected(PAIRS)] and not reader.warnings


@pytest.mark.parametrize("where", ["lower", ""])
@pytest.mark.parametrize("name", ["times.txt", "timestamps.txt"])
def test_a_list_holds_the_seconds_of_numbered_images(tmp_path: Path, where: str, name: str) -> None:
    """In the order of numbers, 10 after 9; the seconds are exact."""
    folder = write_folders(tmp_path / "images", pairs(PAIRS), lambda stamp_ns: f"frame{NUMBERS[stamp_ns]}")
    lines = ["# seconds", "1.7e+09", *(f"1700000000.{number:02d}{number:07d}" for number in range(1, PAIRS))]
    for camera in ["lower", "upper"] if where else [""]:
        (folder / camera / name).write_text("\r\n".join(lines) + "\n", "utf-8-sig")  # as editors of Windows do
    found, _ = read(folder)
    assert [frame[2] for frame in found if frame[0] == "lower"] == [START_NS + 10_000_001 * n for n in range(PAIRS)]
    assert [frame[3] for frame in found if frame[0] == "lower"] == [frame[3] for frame in expected(PAIRS)[::2]]
    (folder / (where or ".") / name).write_text("1.0\n")
    with pytest.raises(DriverError, match="12 images, and its list of stamps 1 lines"):
        LogReader(folder)


# Lines of a list with two columns, by number, stamp [ns] and camera -> name of the file, a line, folder it is in.
LISTS: Final[dict[str, tuple[str, Callable[[int, int, str], str], str]]] = {
    "name and seconds": ("timestamps.txt", lambda n, ns, _: f"frame{n}.jpg;{ns // 10**9}.{ns % 10**9:09d}", "lower"),
    "nanoseconds": ("times.txt", lambda n, ns, _: str(ns), ""),
    "EuRoC": ("data.csv", lambda n, ns, _: f"{ns},frame{n}.jpg", "lower"),
    "TUM": ("rgb.txt", lambda n, ns, camera: f"{ns // 10**9}.{ns % 10**9:09d} {camera}/frame{n}.jpg", ""),
    "KITTI": ("timestamps.txt", lambda n, ns, _: f"2023-11-14 22:13:{20 + n // 10}.{n % 10}00000000", "lower"),
}


@pytest.mark.parametrize("name", LISTS)
@pytest.mark.parametrize("head", ["", "#timestamp [ns],filename\n", "stamp name\n"])
def test_a_list_may_have_names_beside_the_stamps(tmp_path: Path, name: str, head: str) -> None:
    """In any order of lines where it names the images."""
    folder = write_folders(tmp_path / "images", pairs(PAIRS), lambda stamp_ns: f"frame{NUMBERS[stamp_ns]}")
    file, line, where = LISTS[name]
    lines: dict[str, list[str]] = {}
    for number in range(PAIRS):
        for camera in ("lower", "upper"):
            stamp_ns = START_NS + STEP_NS * number
            lines.setdefault(camera if where else "", []).append(line(number, stamp_ns, camera))
    for camera, of_camera in lines.items():
        unique = [*dict.fromkeys(of_camera)]
        if "frame" in unique[0]:
            unique.reverse()
        (folder / camera / file).write_text(head + "\n".join(unique))
    found, reader = read(folder)
    assert not reader.warnings
    for camera in ("lower", "upper"):
        mine = [frame[2:] for frame in found if frame[0] == camera]
        assert [stamp_ns for stamp_ns, _ in mine] == [START_NS + STEP_NS * number for number in range(PAIRS)]
        assert [image for _, image in mine] == [frame[3] for frame in expected(PAIRS) if frame[0] == camera]


def test_images_that_a_list_does_not_name_are_told(tmp_path: Path) -> None:
    folder = write_folders(tmp_path / "images", pairs(PAIRS), lambda stamp_ns: f"frame{NUMBERS[stamp_ns]}")
    (folder / "rgb.txt").write_text("\n".join(f"{number}.5 frame{number}.jpg" for number in range(PAIRS - 2)))
    found, reader = read(folder)
    assert len(found) == 2 * (PAIRS - 2) and reader.truncated
    assert f"2 images of '{folder}/lower' are left out: rgb.txt does not list them" in reader.warnings[0]


def test_numbered_images_have_the_stated_rate(tmp_path: Path) -> None:
    folder = write_folders(tmp_path / "images", pairs(PAIRS), lambda stamp_ns: str(NUMBERS[stamp_ns]))
    with pytest.raises(DriverError, match=r"expected nanoseconds .* seconds in times.txt; else give --rate HZ"):
        LogReader(folder)
    assert stamps(folder, rate_hz=10.0) == as_taken()
    named = write_folders(tmp_path / "named", pairs(PAIRS))
    assert stamps(named, rate_hz=20.0) == [stamp_ns // 2 for stamp_ns in as_taken()], "it replaces the names"


@pytest.mark.parametrize("name", ["frame0", "0000000001", "1_0.5", "1.2.3", "9" * 30])
def test_a_name_that_is_no_stamp_is_refused_and_names_the_setting(tmp_path: Path, name: str) -> None:
    folder = write_folders(tmp_path / "images", pairs(1), lambda _: name)
    with pytest.raises(DriverError, match=r"is named .*log\.rate_hz of the settings"):
        LogReader(folder)


def test_images_named_by_microseconds_are_not_taken_for_nanoseconds(tmp_path: Path) -> None:
    """30 images a second: as nanoseconds they are taken 1,000 times too fast."""
    named = {stamp_ns: str(1_418_381_798_086_398 + 33_333 * number) for stamp_ns, number in NUMBERS.items()}
    folder = write_folders(tmp_path / "images", pairs(PAIRS), named.__getitem__)
    with pytest.raises(DriverError, match=r"33.333 us apart"):
        read(folder)


def test_cameras_of_folders_with_other_names_are_given(tmp_path: Path) -> None:
    folder = write_folders(tmp_path / "images", pairs(PAIRS))
    for camera, name in (("lower", "cam0"), ("upper", "cam1")):
        (folder / "mav0" / name).mkdir(parents=True)
        (folder / camera).rename(folder / "mav0" / name / "data")
    with pytest.raises(DriverError, match="mav0/cam0/data, mav0/cam1/data; give --lower and --upper"):
        LogReader(folder)
    assert read(folder, lower="mav0/cam0/data", upper="mav0/cam1/data")[0] == expected(PAIRS)


@pytest.mark.parametrize("kind", ["pipe", "a link that leads nowhere"])
@pytest.mark.parametrize("name", ["lower/1700000000000000001.jpg", "rig.toml"])
def test_what_is_no_file_is_told_and_not_waited_for(tmp_path: Path, kind: str, name: str) -> None:
    folder = write_folders(tmp_path / "images", pairs(2))
    odd = folder / name
    if kind == "pipe":
        os.mkfifo(odd)
    else:
        odd.symlink_to(tmp_path / "nowhere")
    with closing(LogReader(folder)) as reader:
        assert reader.attachments() == {} and len(list(reader.frames())) == 4
        assert (str(odd) in "".join(reader.warnings)) == (name != "rig.toml")


def test_hidden_files_beside_the_images_are_left_out(tmp_path: Path) -> None:
    """As macOS writes them to other disks."""
    folder = write_folders(tmp_path / "images", pairs(3))
    (folder / "lower" / "._1.jpg").write_bytes(b"\0\5\x16\7")
    with closing(LogReader(folder)) as reader:
        assert len(list(reader.frames())) == 6 and not reader.warnings


@pytest.mark.parametrize("missing", [0, 1])
def test_a_missing_image_is_told_where_a_rate_stands_for_stamps(tmp_path: Path, missing: int) -> None:
    folder = write_folders(tmp_path / "images", pairs(4))
    for path in sorted((folder / "upper").iterdir())[:missing]:
        path.unlink()
    with closing(LogReader(folder, rate_hz=10.0)) as reader:
        assert len(list(reader.frames())) == 8 - missing and len(reader.warnings) == missing
        assert all("found 4 in 'lower', 3 in 'upper'" in line for line in reader.warnings)
