"""Cells that are watched, and those into which something may have come unseen, from where no floor was seen.

What is not watched and was free becomes unknown, as fast as an object may move. README.md has the rules.
"""

from __future__ import annotations

import math
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

NEVER: Final = np.iinfo(np.int64).min
# Time constant of the mean by which a cell is watched, because older evidence shows no motion.
FRESH_NS: Final = 500_000_000
# Most evidence of a pair in the mean, because an object that leaves is noticed in half a second.
MOST_FRESH: Final = 1.2
LEAST_FRESH: Final = 0.4  # Mean evidence from which a cell is watched, because that of noise is 0.2.
FLOOD_MPS: Final = 1.6  # Speed at which an object may enter hidden cells, because a person who walks fast has it.
NARROW_CELLS: Final = 5  # Width from which an object may enter, because that of a person is 25 cm and more.
CROSS: Final = np.array(
    [[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8
)  # By turns with a square, a step of the flood is nearly a circle.
GAP: Final = np.ones((3, 3), np.uint8)  # Nothing comes through narrower gaps, because noise opens such in walls.
# An object may have come for so long through a hidden cell that was free, because a door may have been opened.
ONCE_FREE_NS: Final = 30_000_000_000


class Watch:
    """Mean evidence of each cell of a square, when it was free last, and whether something may be there unseen."""

    def __init__(self, cells: int, cell_m: float) -> None:
        """cells: side of the square; cell_m: side of a cell."""
        self._steps_per_s = FLOOD_MPS / cell_m
        self._carry = 0.0  # part of a step that is left from the pair before
        self.evidence = np.zeros((cells, cells), np.float32)  # mean of the last FRESH_NS
        self.floor_ns = np.full((cells, cells), NEVER, np.int64)  # stamp of the last pair at which a cell was floor
        self.free_ns = self.floor_ns.copy()  # the same of cells that were free by all layers
        self.flooded = np.zeros((cells, cells), np.uint8)  # 1 where something may have come unseen

    @property
    def layers(self) -> tuple[tuple[NDArray[Any], float], ...]:
        """The layers (cells, cells), and what each holds where nothing is known."""
        return (self.evidence, 0), (self.floor_ns, NEVER), (self.free_ns, NEVER), (self.flooded, 0)

    @property
    def watched(self) -> Flags:
        """Cells of which there is enough evidence lately."""
        return np.asarray(self.evidence > LEAST_FRESH)

    def was_floor(self, stamp_ns: int) -> Flags:
        """Return the cells that were floor lately, at a stamp."""
        return np.asarray(self.floor_ns > stamp_ns - ONCE_FREE_NS)

    def take(self, passed_ns: int, window: tuple[slice, slice], amount: Floats) -> None:
        """Take the amount of evidence of a pair in a window into the mean, passed_ns after the pair before."""
        kept = math.exp(-passed_ns / FRESH_NS)
        self.evidence *= np.float32(kept)
        self.evidence[window] += np.float32(1 - kept) * np.clip(amount, 0, MOST_FRESH)

    def spread(self, stamp_ns: int, passed_ns: int, floor: Flags, visible: Flags) -> Flags:
        """Return the cells of floor to which something may have come that was not seen.

        floor: cells of seen floor; visible: those that a pair can show.
        """
        self._carry += min(passed_ns * 1e-9, 1.0) * self._steps_per_s
        steps, self._carry = int(self._carry), self._carry % 1.0
        unwatched = ~self.watched
        self.floor_ns[floor] = stamp_ns
        # 1. Where it may come from: what was free by all layers, wider than an object, and is hidden or lost. Noise
        # shows floor beyond walls, too, through which nothing comes.
        was_free = self.free_ns > stamp_ns - ONCE_FREE_NS
        lost = (unwatched & (visible | ~floor) & was_free).view(np.uint8)
        box = np.ones((NARROW_CELLS, NARROW_CELLS), np.uint8)
        reached = np.asarray(cv2.morphologyEx(lost, cv2.MORPH_OPEN, box), np.uint8) | (self.flooded & lost)
        # 2. How far it may have come since the pair before, through what is not watched.
        ways = (floor & unwatched).view(np.uint8) | lost
        passable = np.asarray(cv2.morphologyEx(ways, cv2.MORPH_OPEN, GAP), np.uint8)
        for step in range(steps):
            kernel = np.ones((3, 3), np.uint8) if step % 2 else CROSS
            reached = np.asarray(cv2.dilate(reached, kernel), np.uint8) & passable
        self.flooded[:] = reached
        return np.asarray((reached > 0) & floor)
