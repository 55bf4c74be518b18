"""`omnid diff` on recordings with known differences, and on invalid files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib import se3
from drivers.logs.mcap_writer import LogWriter
from omnid.cli import main
from omnid.recordings.comparison import table_differences
from omnid.transport import codec
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import ODOMETRY
from tests.drivers.logs.mcap_logs import START_NS

PERIOD_NS = 10**8
COUNT = 20


def pose(index: int, off_m: float = 0.0, off_deg: float = 0.0) -> np.ndarray:
    """Return a pose on a circle, displaced and rotated by so much."""
    turn = se3.rotation_exp((0, 0, 0.1 * index + math.radians(off_deg)))
    return se3.transform(turn, (math.sin(0.1 * index), 1 - math.cos(0.1 * index) + off_m, 0.0))


def stamp_ns(index: int) -> int:
    return START_NS + index * PERIOD_NS


def text_of(index: int) -> str:
    return f"{stamp_ns(index) // 10**9}.{stamp_ns(index) % 10**9:09d} ({index / 10:.3f} s)"


class Recording:
    """Writer of a recording as a run writes it."""

    def __init__(self, path: Path, settings: str = "", robot: str = "omnid") -> None:
        self.path, self._robot = path, robot
        self._writer = LogWriter(path, {"omnid.toml": settings.encode(), "rig.toml": b"schema = 1\n"})

    def add(self, topic: str, schema: str, data: bytes, index: int) -> None:
        """Add any message."""
        self._writer.write(f"/{self._robot}/{topic}", schema, data, stamp_ns(index))

    def odom(self, index: int, T: np.ndarray) -> None:
        """Add a pose."""
        zero = np.zeros((6, 6))
        data = codec.odometry_cdr(stamp_ns(index), T, zero, np.zeros(6), zero)
        self.add("odom", codec.ODOMETRY_SCHEMA, data, index)

    def state(self, index: int, state: str, resets: int = 0) -> None:
        """Add a change of the state."""
        status = DiagnosticStatus(ODOMETRY, 0, state, {"state": state, "resets": str(resets)})
        self.add("status", codec.DIAGNOSTICS_SCHEMA, codec.diagnostics_cdr(stamp_ns(index), [status]), index)

    def drive(self, index: int, velocity_mps: float) -> None:
        """Add a command."""
        data = codec.twist_stamped_cdr(stamp_ns(index), "base_link", velocity_mps, 0.0)
        self.add("drive", codec.TWIST_SCHEMA, data, index)

    def done(self) -> Path:
        """Complete the file and return its path."""
        self._writer.close()
        return self.path


def run_of(path: Path, poses: Sequence[tuple[int, np.ndarray]], settings: str = "", **more: Any) -> Path:
    recording = Recording(path, settings, **more)
    recording.state(poses[0][0], "tracking")
    for index, T in poses:
        recording.odom(index, T)
        recording.drive(index, 0.3)
    return recording.done()


def circle(off_from: int = COUNT, off_m: float = 0.0, off_deg: float = 0.0) -> list[tuple[int, np.ndarray]]:
    """Return all poses; those from one index on are displaced."""
    return [(i, pose(i, off_m, off_deg) if i >= off_from else pose(i)) for i in range(COUNT)]


def diff(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    capsys.readouterr()
    code = main(["diff", *map(str, words)])
    out, err = capsys.readouterr()
    return code, err if code == 2 else out


@pytest.fixture
def first(tmp_path: Path) -> Path:
    return run_of(tmp_path / "a.mcap", circle())


def test_a_copy_is_identical(capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path) -> None:
    other = tmp_path / "copy.mcap"
    other.write_bytes(first.read_bytes())
    code, out = diff(capsys, first, other)
    assert code == 0 and out.endswith("are identical, byte for byte\n")


def test_the_same_poses_in_another_file_are_bit_identical(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path
) -> None:
    code, out = diff(capsys, first, run_of(tmp_path / "b.mcap", circle(), "a = 1"))
    assert code == 0 and "bit-identical" in out and "at most 0.000 mm, 0.0000 deg" in out
    assert "a: A nothing, B 1" in out and "rig        the same" in out


def test_reports_the_first_difference(capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path) -> None:
    other = run_of(tmp_path / "b.mcap", circle(12, 0.0071, 0.03))
    code, out = diff(capsys, first, other)
    assert code == 1 and out.endswith("the runs differ: poses\n")
    assert f"more than 5 mm or 0.1 deg first at {text_of(12)}: 7.100 mm, 0.0300 deg; at 8 poses in all" in out
    assert f"bit-identical before {text_of(12)}" in out
    assert diff(capsys, first, other, "--tolerance-mm", 7.2)[0] == 0
    code, out = diff(capsys, first, other, "--tolerance-mm", 7.2, "--tolerance-deg", 0.02)
    assert code == 1 and f"first at {text_of(12)}: 7.100 mm" in out


def test_reports_maximum_and_last_difference(capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path) -> None:
    bent = [(i, pose(i, 0.02 if i == 7 else 0.001 if i == COUNT - 1 else 0.0)) for i in range(COUNT)]
    code, out = diff(capsys, first, run_of(tmp_path / "b.mcap", bent))
    assert code == 1 and "at most 20.000 mm, 0.0000 deg; at the end 1.000 mm, 0.0000 deg" in out


def test_detects_a_rotation_by_half_a_turn(capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path) -> None:
    code, out = diff(capsys, first, run_of(tmp_path / "b.mcap", circle(3, 0.0, 180.0)))
    assert code == 1 and "at most 0.000 mm, 180.0000 deg" in out


def test_angles_wrap_at_half_a_turn(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    both = [
        run_of(tmp_path / f"{name}.mcap", [(0, se3.exp((0, 0, 0, 0, 0, math.radians(turn_deg))))])
        for name, turn_deg in (("a", 170), ("b", -170))
    ]
    code, out = diff(capsys, *both)
    assert code == 1 and "at most 0.000 mm, 20.0000 deg" in out


def test_reports_poses_that_one_run_lacks(capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path) -> None:
    lost = [(i, T) for i, T in circle() if i not in (4, 9, 10, 11)]
    other = run_of(tmp_path / "b.mcap", lost)
    code, out = diff(capsys, first, other)
    assert code == 1 and "the runs differ: less than 90% of the poses are in both" in out
    assert "in both    16 poses (80.0% of the longer run)" in out
    assert f"only in A  4 poses in 2 gaps, the longest of 3 from {text_of(9)} on" in out
    assert "only in B  none" in out
    assert diff(capsys, first, other, "--shared", 80)[0] == 0


def test_reports_different_states_and_resets(capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path) -> None:
    other = Recording(tmp_path / "b.mcap")
    for i, T in circle():
        other.odom(i, T)
    for index, state, resets in ((0, "tracking", 0), (8, "lost", 0), (11, "degraded", 1), (13, "tracking", 1)):
        other.state(index, state, resets)
    code, out = diff(capsys, first, other.done())
    assert code == 1 and out.endswith("the runs differ: states\n")
    assert "states     A 0 changes, 0 resets; B 3 changes, 1 resets" in out
    assert f"different at 12 poses, first at {text_of(8)}: A tracking after 0 resets, B lost after 0 resets" in out


def test_a_run_without_states_agrees(capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path) -> None:
    other = Recording(tmp_path / "b.mcap")
    for i, T in circle():
        other.odom(i, T)
    code, out = diff(capsys, first, other.done())
    assert code == 0 and "; B reports none" in out and "commands   A 20, B 0, 0 of the same stamps" in out


def test_reports_different_commands(capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path) -> None:
    other = Recording(tmp_path / "b.mcap")
    for i, T in circle():
        other.odom(i, T)
        other.drive(i, 0.3 if i < 15 else 0.31)
    code, out = diff(capsys, first, other.done())
    assert code == 1 and out.endswith("the runs differ: commands\n")
    assert f"first at {text_of(15)}: 10.000 mm/s, 0.0000 deg/s; 5 commands in all" in out


def test_aligns_runs_with_different_starts(capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path) -> None:
    elsewhere = se3.exp((3.0, -1.0, 0.2, 0.0, 0.0, 2.0))
    other = run_of(tmp_path / "b.mcap", [(i, elsewhere @ T) for i, T in circle()[2:]])
    code, out = diff(capsys, first, other)
    assert code == 1 and "--align moves B so that they coincide" in out
    code, out = diff(capsys, first, other, "--align")
    assert code == 0 and "at most 0.000 mm, 0.0000 deg" in out


def test_refuses_runs_without_common_stamps(capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path) -> None:
    other = run_of(tmp_path / "b.mcap", [(i + 100, T) for i, T in circle()])
    code, line = diff(capsys, first, other)
    assert code == 2 and line.count("\n") == 1 and "has the same stamp" in line and "omnid replay" in line


def test_a_cut_file_is_compared_as_far_as_it_goes(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    whole = run_of(tmp_path / "b.mcap", circle()).read_bytes()
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    assert main(["diff", str(first), str(cut), "--shared", "10"]) == 0
    shown = capsys.readouterr()
    assert "cut or corrupt" in shown.err
    assert "the runs agree in what could be compared: no difference" in shown.out.splitlines()[-1]


def test_warns_of_unreadable_messages_and_repeated_stamps(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path
) -> None:
    other = Recording(tmp_path / "b.mcap")
    for i, T in [*circle(), (3, pose(3, 9.0))]:
        other.odom(i, T)
    other.add("odom", codec.ODOMETRY_SCHEMA, b"no pose", COUNT)
    other.drive(COUNT, math.nan)
    assert main(["diff", str(first), str(other.done())]) == 0
    err = capsys.readouterr().err
    assert "1 messages on '/omnid/odom' cannot be read" in err and "repeat a stamp" in err
    assert "1 messages on '/omnid/drive' cannot be read" in err


WRONG = {
    "no file": (["{a}", "none.mcap"], "none.mcap"),
    "no log": (["{a}", "{text}"], "is not an MCAP log"),
    "no poses": (["{a}", "{bare}"], "expected a recording of a run"),
    "no such topic": (["{a}", "{a}", "--topic", "/x"], "'/omnid/odom'"),
    "several topics": (["{a}", "{two}"], "--topic"),
    "nan": (["{a}", "{a}", "--tolerance-mm", "nan"], "--tolerance-mm nan"),
    "below 0": (["{a}", "{a}", "--tolerance-deg", "-1"], "--tolerance-deg"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_gives_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path, first: Path, case: str) -> None:
    words, expected = WRONG[case]
    bare, two = Recording(tmp_path / "bare.mcap"), Recording(tmp_path / "two.mcap")
    bare.drive(0, 1.0)
    for topic in ("pose", "other"):
        zero = np.zeros((6, 6))
        two.add(topic, codec.ODOMETRY_SCHEMA, codec.odometry_cdr(START_NS, np.eye(4), zero, np.zeros(6), zero), 0)
    (tmp_path / "text").write_text("no log")
    files = {"a": first, "text": tmp_path / "text", "bare": bare.done(), "two": two.done()}
    code, line = diff(capsys, *(word.format(**files) for word in words))
    assert code == 2 and line.count("\n") == 1 and expected in line


def test_compares_the_named_topic(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for name, off_m in (("a", 0.0), ("b", 1.0)):
        recording = Recording(tmp_path / f"{name}.mcap")
        for i in range(3):
            recording.odom(i, pose(i))
            zero = np.zeros((6, 6))
            data = codec.odometry_cdr(stamp_ns(i), pose(i, off_m), zero, np.zeros(6), zero)
            recording.add("wheels", codec.ODOMETRY_SCHEMA, data, i)
        recording.done()
    both = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    assert diff(capsys, *both, "--topic", "/omnid/odom")[0] == 0
    assert diff(capsys, *both, "--topic", "/omnid/wheels")[0] == 1


def test_names_keys_by_their_paths() -> None:
    a = {"rig": {"T": [[1.0, 0.0], [0.0, 1.0]], "name": "x"}, "same": 1, "flag": True}
    b = {"rig": {"T": [[1.0, 0.0], [0.5, 1.0]], "name": "x"}, "same": 1.0, "flag": 1, "new": "y" * 100}
    found = table_differences(a, b)
    assert [(entry.path, entry.a, entry.b) for entry in found[:2]] == [
        ("rig.T[1][0]", "0.0", "0.5"),
        ("flag", "True", "1"),
    ]
    assert found[2].path == "new" and found[2].a == "nothing" and found[2].b.endswith("(102 characters)")
