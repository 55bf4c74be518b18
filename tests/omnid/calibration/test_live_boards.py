"""Live calibration: which pairs are kept, what is missing, the screen, and pairs of two cameras."""

from __future__ import annotations

import math
import time
from importlib.resources import files
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.boards.board import BoardView
from calib.models.camera import Mask
from drivers.cameras.log_camera import LogCamera, LogClock, LogImages
from drivers.frame import gray
from omnid.calibration.camera_pairs import newest_pairs
from omnid.calibration.coverage import HOURS, CameraCoverage
from omnid.calibration.coverage_screen import COLUMNS, ROWS, disc, status, table
from omnid.calibration.live_boards import LiveBoards, PairOutcome
from omnid.monitor.screen import fitted
from tests.omnid.commands.test_calibrate_rig import BOARD, render_pairs, rig_of
from tests.replay.command import Command

RIM = Mask((100.0, 120.0), 10.0, 100.0)
SAMPLE = Path(str(files("omnid.sample") / "log.mcap"))
OPTIONS = ("--corners", "7x6", "--square-mm", "30")


def at(hour: float, radius: float) -> BoardView:
    """Return a small board about a place of the image, like the hand of a clock."""
    angle = 2 * math.pi * hour / HOURS
    middle = np.array(RIM.center) + radius * np.array([math.sin(angle), -math.cos(angle)])
    return BoardView("", np.vstack([middle, middle + 0.5, [math.nan, math.nan]]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_pairs(rig_of(640), tmp_path_factory.mktemp("pairs"), 3)


def image(folder: Path, name: str) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    return cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_GRAYSCALE)  # type: ignore[return-value]


def test_hours_and_rings_are_those_of_a_clock_in_the_image() -> None:
    coverage = CameraCoverage(RIM)
    for hour, radius in ((12, 15), (3, 60), (9, 95)):
        coverage.add(at(hour, radius))
    counts = coverage.counts()
    assert [tuple(place) for place in np.argwhere(counts)] == [(0, 0), (1, 3), (2, 9)]
    assert coverage.missing() == [
        "no board at 1, 2, 4 to 8, 10, 11 o'clock",
        "one ring only: hold it nearer, farther, higher, lower",
    ]


def test_enough_is_all_hours_and_two_rings() -> None:
    coverage = CameraCoverage(RIM)
    for hour in range(1, 13):
        coverage.add(at(hour, 60))
    assert coverage.missing() == ["one ring only: hold it nearer, farther, higher, lower"]
    for hour in range(1, 7):
        coverage.add(at(2 * hour, 20))
    assert coverage.missing() == []


def test_the_disc_shows_where_boards_were() -> None:
    coverage = CameraCoverage(RIM)
    for _ in range(12):
        coverage.add(at(3, 60))
    rows = disc(coverage, at(9, 60))
    assert len(rows) == ROWS and all(len(row) == COLUMNS for row in rows)
    middle = rows[ROWS // 2]
    assert middle.index("@") < COLUMNS // 2 < middle.index("9") and rows[0].strip(" .") == ""


def test_a_pair_is_kept_where_the_board_stands_still_at_a_new_place(folder: Path) -> None:
    boards = LiveBoards(BOARD)
    first, second = (tuple(image(folder, f"{side}_{name}") for side in ("lower", "upper")) for name in ("00", "01"))
    empty = np.zeros_like(first[0])
    seen = [
        boards.process(pair, need_still=True)
        for pair in (first, first, first, second, second, (empty, empty), (first[0], empty))
    ]
    assert seen == [
        PairOutcome.MOVING,
        PairOutcome.KEPT,
        PairOutcome.SEEN_BEFORE,
        PairOutcome.MOVING,
        PairOutcome.KEPT,
        PairOutcome.NO_BOARD,
        PairOutcome.ONE_CAMERA,
    ]
    assert boards.pairs == 2 and boards.missing()[0] == "13 more positions"
    lines = fitted(table(boards, seen[-1], "Ctrl-C ends"), 60, 20)
    assert len(lines) <= 19 and all(len(line) <= 60 for line in lines) and "more" not in lines[-1]
    values = status(boards, seen[-1]).values
    assert len(values["lower_coverage"]) == len(values["upper_coverage"]) == 36 and values["pairs"] != "0"
    boards.close()


def test_live_writes_what_it_keeps_and_goes_on_where_it_ended(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    omnid, kept = Command(capsys), tmp_path / "kept"
    first = omnid("calibrate", "live", kept, "--log", folder, *OPTIONS)
    assert first.code == 1 and "3 pairs, not enough yet: 12 more positions" in first.err
    assert first.out.splitlines()[0].startswith("1: 14 more positions; both cameras: ")
    assert sorted(path.name for path in kept.iterdir())[::3] == ["lower_001.png", "upper_001.png"]
    np.testing.assert_array_equal(image(kept, "upper_003"), image(folder, "upper_02"))
    again = omnid("calibrate", "live", kept, "--log", folder, *OPTIONS)
    assert again.out == "" and "3 pairs, not enough yet" in again.err and len(list(kept.iterdir())) == 6


def test_wrong_use_of_live_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    omnid = Command(capsys)
    assert "name a folder" in omnid.refused("calibrate", "live", *OPTIONS)
    assert "--square-mm" in omnid.refused("calibrate", "live", tmp_path, "--corners", "7x6")
    assert "/dev/no-camera" in omnid("calibrate", "live", tmp_path, *OPTIONS, "--lower", "/dev/no-camera").err
    (tmp_path / "file").touch()
    assert "name a folder" in omnid.refused("calibrate", "live", tmp_path / "file", *OPTIONS)


def test_pairs_of_cameras_are_the_newest() -> None:
    images, clock = LogImages.load(SAMPLE), LogClock()
    lower, upper = (LogCamera(images, side, clock) for side in ("lower", "upper"))
    begin_s, pairs = time.monotonic(), newest_pairs(lower, upper)
    for _ in islice(pairs, 3):
        time.sleep(0.35)  # more than three images of each camera, which must not wait in a queue
    assert time.monotonic() - begin_s > 1.0
    one, _ = next(pairs)
    lower.close()
    upper.close()
    elapsed_ns = (time.monotonic() - begin_s) * 1e9
    shown = next(frame for _, frame in images.lower if np.array_equal(gray(frame), one))
    first_ns = images.lower[0][1].stamp_ns
    assert 0.9e9 < shown.stamp_ns - first_ns < elapsed_ns
