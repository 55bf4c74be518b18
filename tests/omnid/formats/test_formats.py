"""Files of trajectories, points, plans and grids: exact round trips, replaced at once, strict content."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from ruamel.yaml import YAML

from calib import se3
from calib.rig_file import write_rig
from omnid.core.mapping.scan_grid import FREE, OCCUPIED, UNKNOWN, Grid
from omnid.core.mapping.voxel_map import MapPoints
from omnid.errors import OmnidError
from omnid.formats.exports import write_grid, write_ply, write_whole
from omnid.formats.place_file import write_places
from omnid.formats.plan import drawn_heights, plan_view
from omnid.formats.tum import read_tum, tum_row
from tests.omnid.formats.place_maps import RIG, some_places
from tests.ply import read_ply
from tests.simulation import make_rig

GOOD = "1700000000.099999905 1 2 3 0 0 0 1\n"


def written(tmp_path: Path, content: str | bytes) -> Path:
    path = tmp_path / "poses.txt"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def refusal(tmp_path: Path, content: str | bytes) -> str:
    path = written(tmp_path, content)
    with pytest.raises(OmnidError) as caught:
        read_tum(path)
    message = str(caught.value)
    assert str(path) in message
    assert message.isprintable()  # one line, whatever bytes the file holds
    return message


def random_poses(count: int) -> np.ndarray:
    return se3.exp(np.random.default_rng(3).normal(size=(count, 6)) * [5, 5, 5, 1.5, 1.5, 1.5])


def test_written_rows_are_read_back(tmp_path: Path) -> None:
    T = random_poses(200)
    stamps_ns = 1_700_000_000_000_000_001 + 66_666_667 * np.arange(200)
    rows = [tum_row(int(stamp), pose) for stamp, pose in zip(stamps_ns, T, strict=True)]
    read = read_tum(written(tmp_path, "\n".join(rows)))
    assert np.array_equal(read.stamps_ns, stamps_ns)
    np.testing.assert_allclose(read.T, T, atol=5e-9)
    assert all(float(row.split()[7]) >= 0.0 for row in rows)


@pytest.mark.parametrize(
    ("word", "stamp_ns"),
    [
        ("1700000000.099999905", 1_700_000_000_099_999_905),
        ("1.700000000099999905e+09", 1_700_000_000_099_999_905),
        ("-0.000000001", -1),
    ],
)
def test_stamps_are_exact(tmp_path: Path, word: str, stamp_ns: int) -> None:
    assert read_tum(written(tmp_path, f"{word} 0 0 0 0 0 0 1")).stamps_ns.tolist() == [stamp_ns]


def test_other_layouts_are_accepted(tmp_path: Path) -> None:
    text = "\ufeff# t x y z\r\n\r\n  2.0\t1 2 3   0 0 0 2  # late\r\n#\r\n1.0 4 5 6 0 0 1e8 -1e8 \r\n\n"
    read = read_tum(written(tmp_path, text))
    assert read.stamps_ns.tolist() == [1_000_000_000, 2_000_000_000]
    assert not read.T.flags.writeable and not read.stamps_ns.flags.writeable
    np.testing.assert_array_equal(read.T[:, :3, 3], [[4, 5, 6], [1, 2, 3]])
    np.testing.assert_allclose(read.T[0, :3, :3], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(read.T[1, :3, :3], np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("1 2 3", "found 3: '1 2 3'"),
        ("1 0 0 0 0 0 0 x", "expected numbers, found '1 0 0 0 0 0 0 x'"),
        ("1 0 0 2e9 0 0 0 1", "numbers within 1e+09 m"),
        ("1 0 0 nan 0 0 0 1", "numbers within"),
        ("1 0 0 0 0 0 0 0", "and a unit quaternion"),
        ("nan 0 0 0 0 0 0 1", "stamp in seconds, found 'nan"),
        ("1700000000100000000 0 0 0 0 0 0 1", "stamp in seconds"),
        ("\x00\x1b[2J", "found 1: '\\x00\\x1b[2J'"),
    ],
)
def test_an_error_names_the_wrong_line(tmp_path: Path, line: str, found: str) -> None:
    message = refusal(tmp_path, f"# poses\n{GOOD}{line}\n{GOOD}")
    assert "line 3: expected" in message and found in message


def test_a_repeated_stamp_is_refused_with_both_lines(tmp_path: Path) -> None:
    message = refusal(tmp_path, "2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n\n2.0 9 0 0 0 0 0 1\n")
    assert "line 4" in message and "line 1" in message


def some_points(count: int) -> MapPoints:
    rng = np.random.default_rng(count)
    return MapPoints(
        xyz=rng.normal(0.0, 9.0, (count, 3)).astype(np.float32),
        confidence=rng.uniform(0.0, 1.0, count).astype(np.float32),
        frames=rng.integers(1, 500, count, dtype=np.int32),
        age=rng.integers(0, 500, count, dtype=np.int32),
    )


@pytest.mark.parametrize("count", [0, 1000])
def test_a_map_that_was_written_is_read_again(tmp_path: Path, count: int) -> None:
    path, points = tmp_path / "map.ply", some_points(count)
    write_ply(path, points)
    read = read_ply(path)
    for name in ("xyz", "confidence", "frames", "age"):
        expected, found = getattr(points, name), getattr(read, name)
        assert found.dtype == expected.dtype and np.array_equal(found, expected)


def test_paths_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for name in ("absent/map.ply", "file/map.ply", "folder", "nul\0.ply", "x" * 300):
        with pytest.raises(OmnidError, match="cannot write"):
            write_ply(tmp_path / name, some_points(1))
    with pytest.raises(OmnidError):
        write_ply("/", some_points(1))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]


MARGIN_PX = 64
NO_PATH = np.empty((0, 2))


def points(xyz: NDArray[np.float64], confidence: float = 0.8) -> MapPoints:
    ones = np.ones(len(xyz), dtype=np.int32)
    return MapPoints(xyz.astype(np.float32), np.full(len(xyz), confidence, dtype=np.float32), ones, ones)


def box(x_m: float, y_m: float, z_m: float = 0.0) -> NDArray[np.float64]:
    """Return a filled square of 0.4 m about a point."""
    grid = np.arange(-0.2, 0.21, 0.05)
    x, y = np.meshgrid(x_m + grid, y_m + grid)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z_m)], axis=1)


def area(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the drawn area without its border, as grey levels."""
    inside = image[MARGIN_PX + 2 : -MARGIN_PX - 2, MARGIN_PX + 2 : -MARGIN_PX - 2]
    return np.asarray(cv2.cvtColor(inside, cv2.COLOR_BGR2GRAY), dtype=np.float64)


def dark_centre(image: NDArray[np.uint8]) -> tuple[float, float]:
    """Return mean column and row of the dark pixels, as fractions of the drawn area."""
    grey = area(image)
    rows, columns = np.nonzero(grey < 200)
    return float(columns.mean() / grey.shape[1]), float(rows.mean() / grey.shape[0])


def test_forward_is_right_and_left_is_up() -> None:
    frame = np.array([[-3.0, -3.0], [3.0, 3.0]])
    for x_m, y_m in ((2.0, 1.0), (-2.0, -1.0), (0.5, -2.0)):
        cloud = np.vstack([box(x_m, y_m), [[*corner, 0.0] for corner in frame]])
        column, row = dark_centre(plan_view(points(cloud), NO_PATH, heights_m=drawn_heights(0.0)))
        assert column == pytest.approx(0.5 + x_m / 6.36, abs=0.02)
        assert row == pytest.approx(0.5 - y_m / 6.36, abs=0.02)


@pytest.mark.parametrize(("height_m", "is_drawn"), [(0.0, True), (0.9, False)])
def test_the_floor_below_cameras_of_known_height_is_not_drawn(height_m: float, is_drawn: bool) -> None:
    """It filled the plans of robots whose cameras are lower than a metre; a box on it is drawn."""
    floor_m = -(height_m or 0.9)
    heights_m = drawn_heights(height_m)
    assert (area(plan_view(points(box(0, 0, floor_m + 0.02)), NO_PATH, heights_m=heights_m)) < 200).any() == is_drawn
    assert (area(plan_view(points(box(0, 0, floor_m + 0.25)), NO_PATH, heights_m=heights_m)) < 200).any()


@pytest.mark.slow
def test_a_path_that_jumps_everywhere_is_drawn() -> None:
    """From some 90,000 points on agg refuses it in one piece."""
    wrong = np.random.default_rng(1).uniform(-1e9, 1e9, (100_000, 2))
    assert plan_view(points(box(0, 0)), wrong, heights_m=drawn_heights(0.0)).max(axis=(0, 1)).tolist() == [255] * 3


CELLS = np.array([[FREE, OCCUPIED, UNKNOWN], [UNKNOWN, FREE, FREE]], np.int8)


@pytest.mark.parametrize("name", ["place.yaml", "my place: it's.yml"])
def test_map_server_reads_the_same_cells(tmp_path: Path, name: str) -> None:
    write_grid(tmp_path / name, Grid(CELLS, 0.05, (-1.5, 2.25)))
    described = YAML(typ="safe").load((tmp_path / name).read_text())
    image = cv2.imread(str(tmp_path / described["image"]), cv2.IMREAD_UNCHANGED)
    assert image is not None
    # nav2_map_server/src/map_io.cpp, mode trinary: darkness against both thresholds, first row at the top.
    darkness = (255 - image[::-1].astype(float)) / 255
    read = np.where(
        darkness > described["occupied_thresh"], OCCUPIED, np.where(darkness < described["free_thresh"], FREE, UNKNOWN)
    )
    np.testing.assert_array_equal(read, CELLS)
    assert described["resolution"] == 0.05 and described["origin"] == [-1.5, 2.25, 0.0] and described["negate"] == 0


def write_map(path: Path, content: bytes) -> None:
    write_places(path, some_places(2), RIG)


def write_rig_file(path: Path, content: bytes) -> None:
    write_rig(path, make_rig())


WRITERS = pytest.mark.parametrize("write", [write_whole, write_map, write_rig_file])


@WRITERS
@pytest.mark.parametrize("exists", [True, False])
def test_a_file_is_written_where_its_link_leads(
    tmp_path: Path, write: Callable[[Path, bytes], None], exists: bool
) -> None:
    (tmp_path / "disk").mkdir()
    file, link = tmp_path / "disk" / "file", tmp_path / "link"
    if exists:
        file.write_bytes(b"old")
    link.symlink_to(file)
    write(link, b"new")
    assert link.is_symlink() and os.listdir(tmp_path / "disk") == ["file"]
    assert file.read_bytes() == b"new" if write is write_whole else file.read_bytes() not in (b"", b"old")


@WRITERS
def test_a_link_in_the_place_of_the_temporary_file_is_not_followed(
    tmp_path: Path, write: Callable[[Path, bytes], None]
) -> None:
    victim, path = tmp_path / "victim", tmp_path / "file"
    victim.write_bytes(b"mine")
    (tmp_path / f".file.{os.getpid()}.part").symlink_to(victim)
    write(path, b"new")
    assert victim.read_bytes() == b"mine" and path.is_file() and not path.is_symlink()


@pytest.mark.parametrize("write", [write_whole, write_rig_file])
def test_a_pipe_is_written_and_not_replaced(tmp_path: Path, write: Callable[[Path, bytes], None]) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with open(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK), "rb") as reader:
        write(pipe, b"new")
        assert reader.read()
    assert os.listdir(tmp_path) == ["pipe"] and pipe.is_fifo()
