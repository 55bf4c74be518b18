"""Status of the images' parts: which ones are frozen or blind, of which camera, about the base; and fixed ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles.unwatched import Unwatched
from omnid.core.stereo.tiles import SIDES, Side, TileStates
from omnid.diagnostics.run_statistics import RunStatistics
from omnid.stages.geometry import Geometry
from omnid.transport.codec import ERROR, OK, STALE
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import FIXED_PERCENT, IMAGES, lost_parts_key

LIVE = "all parts are live"
FIXED = (
    "a part of the panoramas ({:.0%}) shows what is fixed to a camera, such as the reflection of its lens: "
    "obstacles are judged without it; `omnid calibrate drive --only mask` on a log of a turn makes a mask of it"
)


class ImagesStatus:
    """The entry; a call makes it from the newest pair."""

    def __init__(
        self,
        geometry: Geometry,
        statistics: RunStatistics,
        report: Callable[[str], object],
        fixed_share: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """report: takes a line for the log where the message changes, and where fixed parts are found first.

        fixed_share: share of the panoramas that shows what is fixed to a camera.
        """
        self._unwatched = Unwatched(geometry.cylinder, geometry.rig.T_base_rig @ geometry.T_rig_rect)
        self._statistics, self._report, self._message = statistics, report, LIVE
        self._fixed_share, self._has_fixed = fixed_share, False

    def __call__(self) -> DiagnosticStatus:
        """Return the entry."""
        newest = self._statistics.newest
        if newest is None:
            return DiagnosticStatus(IMAGES, STALE, "no pose yet", {})
        tiles = newest.depth.panoramas.tiles
        lost = [side for side in SIDES if side in tiles.columns and tiles.columns[side].any()]
        message = "; ".join(self._named(side, tiles) for side in lost) or LIVE
        if message != self._message:
            self._report(f"images: {message}")
        self._message = message
        fixed = self._fixed_share()
        if fixed and not self._has_fixed:
            self._report(f"images: {FIXED.format(fixed)}")
        self._has_fixed = fixed > 0
        values = {lost_parts_key(side): f"{(newest.stamp_ns - tiles.since_ns[side]) * 1e-9:.0f}" for side in lost}
        if fixed:
            values[FIXED_PERCENT] = f"{100 * fixed:.0f}"
        return DiagnosticStatus(IMAGES, ERROR if lost else OK, message, values)

    def _named(self, side: Side, tiles: TileStates) -> str:
        """Return what a camera does not show, such as "the upper camera is blind from 300 to 40 degrees"."""
        columns, is_dead = tiles.columns[side], tiles.dead[side].any(axis=0)
        parts = [
            f"{word} {self._directions(found)}"
            for word, found in (("frozen", columns & is_dead), ("blind", columns & ~is_dead))
            if found.any()
        ]
        return f"the {side} camera is {' and '.join(parts)}"

    def _directions(self, columns: NDArray[np.bool_]) -> str:
        spans = self._unwatched.spans_deg(columns)
        if spans == [(0, 360)]:
            return "all around"
        return " and ".join(f"from {begin} to {end} degrees" for begin, end in spans)
