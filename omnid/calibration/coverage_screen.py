"""Progress of a live calibration: on a terminal, and as an entry of the status for the page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.boards.board import BoardView
from omnid.calibration.coverage import HOURS, NEEDED_PAIRS, RINGS, CameraCoverage, finite_corners
from omnid.calibration.images import SIDES
from omnid.calibration.live_boards import LiveBoards, PairOutcome
from omnid.transport.codec import OK
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import CALIBRATION, Key

ROWS: Final = 11  # Text rows of a disc; a letter is twice as high as wide.
COLUMNS: Final = 2 * ROWS - 1
GAP: Final = "    "
NOTHING, NEWEST = ".", "@"


def table(boards: LiveBoards, outcome: PairOutcome, hint: str) -> Iterator[str]:
    """Yield the lines of a screen of at least 60 x 20: the outcome, both cameras, what is missing."""
    yield f"{boards.pairs} of {NEEDED_PAIRS} pairs   {outcome.upper() if outcome is PairOutcome.KEPT else outcome}"
    yield GAP.join(f"{f'{name} camera':{COLUMNS}}" for name in SIDES)
    if boards.coverage is not None:
        discs = [disc(coverage, view) for coverage, view in zip(boards.coverage, boards.views, strict=True)]
        yield from (GAP.join(rows) for rows in zip(*discs, strict=True))
    yield f"digits: views there; {NOTHING} none yet; {NEWEST} the board now"
    missing = boards.missing()
    yield from (f"missing: {words}" for words in missing)
    yield hint if missing else f"ENOUGH; {hint}"


def disc(coverage: CameraCoverage, newest: BoardView | None) -> list[str]:
    """Return ROWS lines of COLUMNS letters: the image as a disc, with the number of views in each part of it."""
    counts, now = coverage.counts(), _place(coverage, newest)
    middle = (ROWS - 1) / 2
    lines = []
    for row in range(ROWS):
        letters = []
        for column in range(COLUMNS):
            x, y = (column / 2 - middle) / middle, (row - middle) / middle
            letters.append(_letter(counts, now, (x, y)))
        lines.append("".join(letters))
    return lines


def _letter(counts: NDArray[np.int64], now: tuple[float, float] | None, at: tuple[float, float]) -> str:
    """Return the letter of a place; 1 is the rim's radius."""
    half = 1 / (ROWS - 1)
    if now is not None and abs(at[0] - now[0]) <= half / 2 and abs(at[1] - now[1]) <= half:
        return NEWEST
    radius = math.hypot(*at)
    if radius > 1 + half / 2:
        return " "
    hour = round(math.atan2(at[0], -at[1]) / (2 * math.pi) * HOURS) % HOURS
    views = int(counts[min(RINGS - 1, int(radius * RINGS)), hour])
    return str(min(views, 9)) if views else NOTHING


def _place(coverage: CameraCoverage, view: BoardView | None) -> tuple[float, float] | None:
    """Return the middle of a view, in parts of the rim's radius from its centre."""
    if view is None:
        return None
    x, y = (finite_corners(view).mean(axis=0) - coverage.rim.center) / coverage.rim.outer_px
    return float(x), float(y)


def status(boards: LiveBoards, outcome: PairOutcome) -> DiagnosticStatus:
    """Return the progress as an entry of the status."""
    values = {Key.PAIRS: str(boards.pairs), Key.NEEDED: str(NEEDED_PAIRS)}
    for key, coverage in zip((Key.LOWER_COVERAGE, Key.UPPER_COVERAGE), boards.coverage or (), strict=False):
        values[key] = "".join(str(min(9, count)) for count in coverage.counts().ravel())
    missing = "; ".join(boards.missing())
    if missing:
        values[Key.MISSING] = missing
    return DiagnosticStatus(CALIBRATION, OK, str(outcome), {str(k): v for k, v in values.items()})
