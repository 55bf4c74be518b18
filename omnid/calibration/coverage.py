"""Coverage of a camera's image by the boards seen so far: sectors like the hours of a clock, and three rings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.boards.board import BoardView
from calib.models.camera import Array, Mask

HOURS: Final = 12  # sectors; hour 12 is the top of the image
RINGS: Final = 3  # Number of rings of equal width from the hub to the rim.
NEEDED_PAIRS: Final = 15
NEEDED_RINGS: Final = 2  # Rings that need boards at half of the hours: boards that both cameras see reach no more.
# Two positions of a board differ if their corners are this far apart on average, in parts of the rim's radius.
NEW_VIEW_PART: Final = 0.06
STILL_PART: Final = 0.004  # a board that is held still moves less between two images


@dataclass
class CameraCoverage:
    """Views of one camera; rim: the ring of the image that shows the world."""

    rim: Mask
    views: list[Array] = field(default_factory=list)  # (N, 2) px each, finite

    def add(self, view: BoardView) -> None:
        """Count a view."""
        self.views.append(finite_corners(view))

    def counts(self) -> NDArray[np.int64]:
        """Return the number of views (RINGS, HOURS) that have a corner there; hour 0 is at 12 o'clock."""
        total = np.zeros((RINGS, HOURS), np.int64)
        for pixels in self.views:
            seen = np.zeros((RINGS, HOURS), bool)
            offset = pixels - self.rim.center
            ring = (np.hypot(*offset.T) - self.rim.inner_px) / (self.rim.outer_px - self.rim.inner_px)
            clockwise = np.arctan2(offset[:, 0], -offset[:, 1])  # from the top of the image, v points down
            hour = np.round(clockwise / (2 * math.pi) * HOURS).astype(int) % HOURS
            seen[np.clip((ring * RINGS).astype(int), 0, RINGS - 1), hour] = True
            total += seen
        return total

    def missing(self) -> list[str]:
        """Return a text about what no board covers yet, for the person who holds the board."""
        counts = self.counts()
        hours = [int(hour) or HOURS for hour in np.flatnonzero(counts.sum(axis=0) == 0)]
        found = [f"no board at {_listed(sorted(hours))} o'clock"] if hours else []
        rings = int((np.count_nonzero(counts, axis=1) >= HOURS // 2).sum())
        if rings < NEEDED_RINGS:
            found.append("one ring only: hold it nearer, farther, higher, lower")
        return found


def finite_corners(view: BoardView) -> Array:
    """Return the known corners (N, 2) px."""
    return view.pixels[np.isfinite(view.pixels).all(axis=1)]


def moved(a: BoardView | None, b: BoardView | None) -> float:
    """Return the mean distance of the corners that both views have, px; inf where they have none."""
    if a is None or b is None:
        return math.inf
    distance = np.linalg.norm(a.pixels - b.pixels, axis=1)
    known = distance[np.isfinite(distance)]
    return float(known.mean()) if known.size else math.inf


def _listed(hours: Sequence[int]) -> str:
    """Return "1 to 4, 9" for 1, 2, 3, 4, 9."""
    groups: list[list[int]] = []
    for hour in hours:
        if groups and groups[-1][-1] == hour - 1:
            groups[-1].append(hour)
        else:
            groups.append([hour])
    return ", ".join(f"{group[0]} to {group[-1]}" if len(group) > 2 else ", ".join(map(str, group)) for group in groups)
