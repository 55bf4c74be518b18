"""Boards in the images of both cameras as they come: which to keep, what they cover, and what is missing."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from enum import StrEnum
from typing import Final

import numpy as np

from calib.boards.board import AnyBoard
from calib.models.camera import Array
from calib.rig import SIDES
from drivers.errors import FrameDecodeError
from drivers.frame import FrameSource, gray
from omnid.calibration.board_search import require_one_orientation, search_board
from omnid.calibration.images import Image
from omnid.errors import OmnidError
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.status_names import CALIBRATION, Key, entry

HOURS: Final = 12  # sectors; hour 12 is the top of the image
RINGS: Final = 3  # Number of rings of equal width in the largest disc of the image.
NEEDED_PAIRS: Final = 15
# Two positions of a board differ if their corners are this far apart on average, as a fraction of the disc's radius.
NEW_VIEW_PART: Final = 0.06
STILL_PART: Final = 0.004  # a board that is held still moves less between two images
Views = tuple[Array | None, Array | None]  # corners (N, 2) [px], see find_board


class CameraCoverage:
    """What the views of one camera with images of a shape (H, W) cover of the largest disc in these."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.shape = shape
        # The number of views (RINGS, HOURS) that have a corner there; hour 0 is at 12 o'clock.
        self.counts = np.zeros((RINGS, HOURS), np.int64)

    @property
    def radius_px(self) -> float:
        """Return the radius of the disc."""
        return min(self.shape) / 2

    def add(self, pixels: Array) -> None:
        """Count a view with corners at pixels (N, 2), those that are not known NaN."""
        offset = pixels[np.isfinite(pixels[:, 0])] - np.array(self.shape[::-1]) / 2
        ring = (np.hypot(*offset.T) / self.radius_px * RINGS).astype(int)
        clockwise = np.arctan2(offset[:, 0], -offset[:, 1]) / (2 * math.pi)  # v points down
        hours = np.round(clockwise * HOURS).astype(int) % HOURS
        seen = np.zeros((RINGS, HOURS), bool)
        seen[np.minimum(ring, RINGS - 1), hours] = True
        self.counts += seen

    def missing(self) -> list[str]:
        """Return a text about what no board covers yet, for the person who holds the board."""
        hours = [int(hour) or HOURS for hour in np.flatnonzero(self.counts.sum(axis=0) == 0)]
        found = [f"no board at {', '.join(map(str, sorted(hours)))} o'clock"] if hours else []
        # Two rings need boards at half of the hours: boards that both cameras see reach no more.
        if (np.count_nonzero(self.counts, axis=1) >= HOURS // 2).sum() < 2:
            found.append("one ring only: hold it nearer, farther, higher, lower")
        return found


def moved(a: Array | None, b: Array | None) -> float:
    """Return the mean distance of the corners that both views have, px; inf where they have none."""
    if a is None or b is None:
        return math.inf
    distance = np.linalg.norm(a - b, axis=1)
    known = distance[np.isfinite(distance)]
    return float(known.mean()) if known.size else math.inf


class PairOutcome(StrEnum):
    """The use of a pair of images."""

    KEPT = "kept"
    NO_BOARD = "no board"
    ONE_CAMERA = "one camera only"
    MOVING = "hold it still"
    SEEN_BEFORE = "seen there before: move it"


class LiveBoards:
    """Takes pairs of images one after the other; keeps those that add information."""

    def __init__(self, board: AnyBoard) -> None:
        require_one_orientation(board)
        self._board = board
        self._before: Views = (None, None)
        self._kept: list[tuple[Array, Array]] = []
        self.coverage: tuple[CameraCoverage, ...] = ()  # of both cameras after the first pair of images
        self._pool = ThreadPoolExecutor(len(SIDES))

    @property
    def pairs(self) -> int:
        """Number of kept pairs."""
        return len(self._kept)

    def missing(self) -> list[str]:
        """Return what is missing until a calibration is worth while; empty where there is enough."""
        found = [f"{NEEDED_PAIRS - self.pairs} more positions"] if self.pairs < NEEDED_PAIRS else []
        sides = zip(SIDES, self.coverage, strict=True)
        return found + [f"{name} camera: {words}" for name, coverage in sides for words in coverage.missing()]

    def process(self, images: Sequence[Image], *, need_still: bool) -> PairOutcome:
        """Search the board in images of the lower and the upper camera at one instant, and keep the pair if it is new.

        need_still: the pair is kept only if the board was at the same place in the pair before.
        """
        # 1. Search the board.
        shapes = [image.shape for image in images]
        self.coverage = self.coverage or tuple(map(CameraCoverage, shapes))
        if shapes != [coverage.shape for coverage in self.coverage]:
            raise OmnidError("expected images as large as the first ones; name another folder for another size")
        lower, upper = self._pool.map(lambda image: search_board(image, self._board), images)
        before, self._before = self._before, (lower, upper)
        # 2. Leave out pairs that add no information.
        if lower is None and upper is None:
            return PairOutcome.NO_BOARD
        if lower is None or upper is None:
            return PairOutcome.ONE_CAMERA
        if need_still and not self._near(before, (lower, upper), STILL_PART):
            return PairOutcome.MOVING
        if any(self._near(kept, (lower, upper), NEW_VIEW_PART) for kept in self._kept):
            return PairOutcome.SEEN_BEFORE
        # 3. Keep the pair, and count what it covers.
        self._kept.append((lower, upper))
        for coverage, view in zip(self.coverage, (lower, upper), strict=True):
            coverage.add(view)
        return PairOutcome.KEPT

    def close(self) -> None:
        """End the threads of the search."""
        self._pool.shutdown()

    def _near(self, a: Views, b: Views, part: float) -> bool:
        """True if the board moved by at most `part` of the disc's radius from a to b, in both cameras."""
        return all(
            moved(one, other) <= part * coverage.radius_px
            for one, other, coverage in zip(a, b, self.coverage, strict=True)
        )


def status(boards: LiveBoards, outcome: PairOutcome) -> DiagnosticStatus:
    """Return the progress as an entry of the status, for the page."""
    values = {Key.PAIRS: str(boards.pairs), Key.NEEDED: str(NEEDED_PAIRS)}
    for key, coverage in zip((Key.LOWER_COVERAGE, Key.UPPER_COVERAGE), boards.coverage, strict=False):
        values[key] = "".join(str(min(9, count)) for count in coverage.counts.ravel())
    return entry(CALIBRATION, {**values, Key.MISSING: "; ".join(boards.missing()), "_ok": outcome})


def newest_pairs(lower: FrameSource, upper: FrameSource) -> Iterator[tuple[Image, Image]]:
    """Yield pairs of images that were taken since the pair was asked for; the cameras take turns.

    What they see must stand still meanwhile, which the caller checks. Images that waited in a buffer are left out, so
    that a slow caller sees what is there now. Ends with either camera.
    """
    frames = lower.frames(), upper.frames()
    while True:
        pair = []
        for source in frames:
            asked_ns, image = time.monotonic_ns(), None
            while image is None:
                frame = next(source, None)
                if frame is None:
                    return
                if frame.stamp_ns >= asked_ns:
                    with suppress(FrameDecodeError):
                        image = gray(frame)
            pair.append(image)
        yield pair[0], pair[1]
