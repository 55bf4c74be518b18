"""TUM files: exact stamps, tolerant layout, strict content."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib import se3
from omnid.errors import OmnidError
from omnid.formats.tum import read_tum, tum_row

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


def test_rows_written_are_read_back(tmp_path: Path) -> None:
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
        ("1700000000.123456789", 1_700_000_000_123_456_789),
        ("0", 0),
        (".5", 500_000_000),
        ("-0.000000001", -1),
        ("1e-300", 0),
    ],
)
def test_stamps_are_exact(tmp_path: Path, word: str, stamp_ns: int) -> None:
    assert read_tum(written(tmp_path, f"{word} 0 0 0 0 0 0 1")).stamps_ns.tolist() == [stamp_ns]


def test_accepts_other_layouts(tmp_path: Path) -> None:
    text = "\ufeff# t x y z\r\n\r\n  2.0\t1 2 3   0 0 0 2  # late\r\n#\r\n1.0 4 5 6 0 0 1e300 -1e300 \r\n\n"
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
        ("1 " * 9, "found 9"),
        ("1,0,0,0,0,0,1", "found 7: '1 0 0 0 0 0 1'"),
        ("1 0 0 0 0 0 0 x", "expected finite numbers, found '1 0 0 0 0 0 0 x'"),
        ("1 0 0 nan 0 0 0 1", "finite"),
        ("1 0 -inf 0 0 0 0 1", "finite"),
        ("1 0 0 1e400 0 0 0 1", "finite"),
        ("1 0 0 2e9 0 0 0 1", "position within"),
        ("1 0 0 0 0 0 0 0", "found zero"),
        ("nan 0 0 0 0 0 0 1", "stamp in seconds, found 'nan'"),
        ("today 0 0 0 0 0 0 1", "'today'"),
        ("1e999999999 0 0 0 0 0 0 1", "'1e999999999'"),
        ("1e99999999999999999999999 0 0 0 0 0 0 1", "stamp"),
        ("1700000000000000000 0 0 0 0 0 0 1", "stamp"),
        ("\x00\x1b[2J", "found 1: '\\x00\\x1b[2J'"),
    ],
)
def test_names_the_wrong_line(tmp_path: Path, line: str, found: str) -> None:
    message = refusal(tmp_path, f"# poses\n{GOOD}{line}\n{GOOD}")
    assert "line 3: expected" in message and found in message


@pytest.mark.parametrize(
    "text",
    [
        "#timestamp [ns], p_x [m], p_y [m], p_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_x []\r\n"
        "1700000000100000000,1,2,3,0.5,0.5,0.5,-0.5,9\r\n1700000000200000000,1,2,3,1,0,0,0,9\r\n",
        "timestamp,x,y,z,qx,qy,qz,qw\n1700000000.1,1,2,3,.5,.5,-.5,.5\n1700000000.2,1,2,3,0,0,0,1\n",
        "# t tx ty tz qw qx qy qz\n1700000000.1 1 2 3 -.5 -.5 -.5 .5\n1700000000.2 1 2 3 1 0 0 0\n",
        "1700000000100000000 1 2 3 .5 .5 -.5 .5\n1700000000200000000 1 2 3 0 0 0 1\n",
        "1700000000100000 1 2 3 .5 .5 -.5 .5\n1700000000200000 1 2 3 0 0 0 1\n",
    ],
)
def test_reads_columns_as_the_head_names_them(tmp_path: Path, text: str) -> None:
    read = read_tum(written(tmp_path, text))
    assert read.stamps_ns.tolist() == [1_700_000_000_100_000_000, 1_700_000_000_200_000_000]
    np.testing.assert_allclose(se3.quaternion(read.T[:, :3, :3]), [[0.5, 0.5, -0.5, 0.5], [0, 0, 0, 1]], atol=1e-12)


def test_refuses_random_bytes(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    letters = np.frombuffer(b"0123456789.-+eE naif_#,\t\n\r\x00\xc3\xa9", dtype=np.uint8)
    for size in range(1, 400, 3):
        path = written(tmp_path, rng.choice(letters, size).tobytes())
        try:
            read_tum(path)
        except OmnidError as error:
            assert str(path) in str(error)


def test_repeated_stamp_names_both_lines(tmp_path: Path) -> None:
    message = refusal(tmp_path, "2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n\n2.0 9 0 0 0 0 0 1\n")
    assert "line 4" in message and "line 1" in message
