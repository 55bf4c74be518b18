"""Memory of the dense depths of pairs, which several stages share."""

from __future__ import annotations

from collections.abc import Callable
from weakref import WeakKeyDictionary

from omnid.core.odometry.earlier_view import EarlierView
from omnid.core.odometry.exposure_times import Exposure
from omnid.engine.threads import Lock
from omnid.messages import DensePoints, Panoramas, StereoDepth

# Computes the dense depth of panoramas for a motion during their exposures; None: unknown, or none is needed.
Compute = Callable[[Panoramas, Exposure | None], DensePoints]
# Returns dense points without those that the earlier view of a depth contradicts.
Confirm = Callable[[StereoDepth, DensePoints], DensePoints]


class DenseDepths:
    """Dense depths, computed when they are first asked for.

    Matching costs as much as the odometry of a pair, and few pairs need it: keyframes, and those that enter the map or
    the obstacle ring. What was computed is remembered as long as the panoramas of the pair exist. Any thread may ask;
    while one computes, others that ask for the same pair wait for the result.
    """

    def __init__(self, compute: Compute, confirm: Confirm = lambda _, dense: dense) -> None:
        self._compute, self._confirm = compute, confirm
        self._known: WeakKeyDictionary[Panoramas, _Known] = WeakKeyDictionary()
        self._one = Lock()

    def of(self, depth: StereoDepth) -> DensePoints:
        """Return the dense depth of a pair whose pose is known: points that its earlier view does not contradict."""
        known, dense = self._of(depth.panoramas), self.points(depth.panoramas, depth.exposure)
        with known.one:
            if known.confirmed is None or known.confirmed[0] is not dense or known.confirmed[1] is not depth.earlier:
                known.confirmed = dense, depth.earlier, self._confirm(depth, dense)
            return known.confirmed[2]

    def points(self, panoramas: Panoramas, exposure: Exposure | None = None) -> DensePoints:
        """Return the depth of panoramas, as matched; of several motions during the exposures the last is remembered."""
        known = self._of(panoramas)
        with known.one:
            if known.points is None or known.exposure is not exposure:
                known.points, known.exposure = self._compute(panoramas, exposure), exposure
            return known.points

    def _of(self, panoramas: Panoramas) -> _Known:
        with self._one:
            return self._known.setdefault(panoramas, _Known())


class _Known:
    """Depth of a pair that was computed last, and the motion for which it was corrected."""

    def __init__(self) -> None:
        self.points: DensePoints | None = None
        self.exposure: Exposure | None = None
        self.confirmed: tuple[DensePoints, EarlierView | None, DensePoints] | None = None  # as matched, by it, without
        self.one = Lock()
