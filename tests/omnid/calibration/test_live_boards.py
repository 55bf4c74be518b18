"""Live calibration: which pairs are kept."""

from __future__ import annotations

import math
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.boards.board import BoardView
from calib.models.camera import Mask
from omnid.calibration.live_boards import HOURS, LiveBoards, PairOutcome, status
from tests.omnid.commands.test_calibrate_board import BOARD, render_pairs, rig_of

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


SAMPLE = Path(str(files("omnid.sample") / "log.mcap"))
