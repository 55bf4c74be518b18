"""Boards in the images of both cameras as they come: which of them to keep, and what is missing for a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from enum import StrEnum
from typing import Final

import numpy as np

from calib.boards.board import BoardView
from calib.masks.rim import find_rim
from calib.models.camera import Mask
from omnid.calibration.board_search import AnyBoard, search_board
from omnid.calibration.coverage import NEEDED_PAIRS, NEW_VIEW_PART, STILL_PART, CameraCoverage, moved
from omnid.calibration.images import SIDES, Image, middle_px
from omnid.errors import OmnidError

MOST_PAIRS: Final = 200
Views = tuple[BoardView | None, BoardView | None]


class PairOutcome(StrEnum):
    """The use of a pair of images."""

    KEPT = "kept"
    NO_BOARD = "no board"
    ONE_CAMERA = "one camera only"
    MOVING = "hold it still"
    SEEN_BEFORE = "seen there before: move it"
    FULL = "enough pairs are kept"


class LiveBoards:
    """Takes pairs of images one after the other; keeps those that add information."""

    def __init__(self, board: AnyBoard) -> None:
        self._board = board
        self._brightest: list[Image] = []  # the maximum of each camera's images, in which the rim is searched
        self._rims: list[Mask | None] = [None, None]
        self._before: Views = (None, None)
        self._kept: list[tuple[BoardView, BoardView]] = []
        self.coverage: tuple[CameraCoverage, CameraCoverage] | None = None  # after the first pair of images
        self.views: Views = (None, None)  # of the newest images
        self._pool = ThreadPoolExecutor(len(SIDES))

    @property
    def pairs(self) -> int:
        """Number of kept pairs."""
        return len(self._kept)

    def missing(self) -> list[str]:
        """Return what is missing until a calibration is worth while; empty where there is enough."""
        found = [f"{NEEDED_PAIRS - self.pairs} more positions"] if self.pairs < NEEDED_PAIRS else []
        if self.coverage is None:
            return found
        lower, upper = (coverage.missing() for coverage in self.coverage)
        found += [f"both cameras: {words}" for words in lower if words in upper]
        found += [f"lower camera: {words}" for words in lower if words not in upper]
        return found + [f"upper camera: {words}" for words in upper if words not in lower]

    def process(self, images: Sequence[Image], *, need_still: bool) -> PairOutcome:
        """Search the board in the images of the lower and the upper camera at one instant.

        need_still: they count only where the board was at the same place in the pair before.
        """
        # 1. Search the board.
        self._update_rims(images)
        lower, upper = self._pool.map(lambda image: search_board(image, self._board, thorough=False).view, images)
        before, self._before, self.views = self._before, (lower, upper), (lower, upper)
        # 2. Leave out what says nothing new.
        if lower is None and upper is None:
            return PairOutcome.NO_BOARD
        if lower is None or upper is None:
            return PairOutcome.ONE_CAMERA
        if need_still and not self._near(before, (lower, upper), STILL_PART):
            return PairOutcome.MOVING
        if any(self._near(kept, (lower, upper), NEW_VIEW_PART) for kept in self._kept):
            return PairOutcome.SEEN_BEFORE
        if self.pairs >= MOST_PAIRS:
            return PairOutcome.FULL
        # 3. Keep the pair, and count what it covers.
        self._kept.append((lower, upper))
        for coverage, view in zip(self._covered(), (lower, upper), strict=True):
            coverage.add(view)
        return PairOutcome.KEPT

    def close(self) -> None:
        """End the threads of the search."""
        self._pool.shutdown()

    def _near(self, a: Views, b: Views, part: float) -> bool:
        """True if both boards are nearly at the same places in both views, as parts of the rims' radii."""
        return all(
            moved(one, other) <= part * coverage.rim.outer_px
            for one, other, coverage in zip(a, b, self._covered(), strict=True)
        )

    def _covered(self) -> tuple[CameraCoverage, CameraCoverage]:
        assert self.coverage is not None  # since the first images
        return self.coverage

    def _update_rims(self, images: Sequence[Image]) -> None:
        """Search the rims in the brightest of all images until both are found; until then use the whole image."""
        if not self._brightest:
            self._brightest = [image.copy() for image in images]
            self.coverage = CameraCoverage(_whole(images[0])), CameraCoverage(_whole(images[1]))
        for name, before, image in zip(SIDES, self._brightest, images, strict=True):
            if image.shape != before.shape:
                raise OmnidError(
                    f"{name} camera: expected images of {_size(before)} px as the first ones, found {_size(image)} px; "
                    "set the size of the camera, or name another folder"
                )
        for side, image in enumerate(images):
            if self._rims[side] is None:
                np.maximum(self._brightest[side], image, out=self._brightest[side])
                found = self._rims[side] = find_rim(self._brightest[side], middle_px(image))
                if found is not None:
                    self._covered()[side].rim = found


def _size(image: Image) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _whole(image: Image) -> Mask:
    """Return the largest disc in an image."""
    return Mask(middle_px(image), 0.0, (min(image.shape) - 1) / 2)
