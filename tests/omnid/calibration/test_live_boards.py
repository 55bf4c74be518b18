"""Live calibration: which pairs are kept, what they cover, what is missing, and pairs of two cameras."""

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
from omnid.calibration.live_boards import HOURS, CameraCoverage, LiveBoards, PairOutcome, newest_pairs, status
from tests.omnid.commands.test_calibrate_rig import BOARD, render_pairs, rig_of

PAIRS = 2  # of different places


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_pairs(rig_of(640), tmp_path_factory.mktemp("pairs"), PAIRS)


def image(folder: Path, name: str) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    return cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_GRAYSCALE)  # type: ignore[return-value]


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
    values = status(boards, seen[-1]).values
    assert len(values["lower_coverage"]) == len(values["upper_coverage"]) == 36 and values["pairs"] != "0"
    boards.close()


RIM = Mask((100.0, 120.0), 10.0, 100.0)


def at(hour: float, radius: float) -> BoardView:
    """Return a small board about a place of the image, like the hand of a clock."""
    angle = 2 * math.pi * hour / HOURS
    middle = np.array(RIM.center) + radius * np.array([math.sin(angle), -math.cos(angle)])
    return BoardView("", np.vstack([middle, middle + 0.5, [math.nan, math.nan]]))


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


SAMPLE = Path(str(files("omnid.sample") / "log.mcap"))


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
