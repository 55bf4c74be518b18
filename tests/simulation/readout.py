"""Times of exposure of a pair's two images: speed of the run, skew between the cameras, rolling shutters.

The upper exposure begins at lower exposure + skew + stamp offset; its stamp is lower stamp + skew, so the offset is an
error that no stamp shows. A camera's stamp is the exposure of its first image row; row r is exposed r * line time
later.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib import se3
from calib.models.camera import Array

PERIOD_NS = 100_000_000
# Two steps whose rotations differ by more are not averaged: the smaller one is the motion during the exposures.
MAX_CHANGE_RAD = np.deg2rad(10.0)


@dataclass(frozen=True, slots=True)
class Readout:
    """Times of the exposures of a log; the default is a global shutter and simultaneous exposures.

    skew_ms: of the first and of the last pair, linear between. line_time_us: from one image row to the next, lower and
    upper camera.
    """

    speed: float = 1.0  # factor on the speed of the run: the pairs follow faster, the poses stay
    skew_ms: tuple[float, float] = (0.0, 0.0)
    stamp_offset_ms: float = 0.0
    line_time_us: tuple[float, float] = (0.0, 0.0)

    @property
    def period_ns(self) -> int:
        """Return the time from one pair to the next."""
        return round(PERIOD_NS / self.speed)

    @property
    def is_synchronous(self) -> bool:
        """True if both images show the same instant."""
        return not (any(self.skew_ms) or self.stamp_offset_ms or any(self.line_time_us))

    def skew_ns(self, pairs: int) -> Array:
        """Return upper minus lower stamp (N,) [ns] of every pair."""
        return np.rint(1e6 * np.linspace(*self.skew_ms, pairs))

    def delay_s(self, pairs: int) -> Array:
        """Return the time (N,) [s] from the lower to the upper exposure of every pair."""
        return np.asarray(1e-9 * self.skew_ns(pairs) + 1e-3 * self.stamp_offset_ms)


def body_twists(poses: Array, period_s: float) -> Array:
    """Return the twists (N, 6) per second of the rig at poses T_world_rig (N, 4, 4), in its own frame.

    Mean of the step before and the step after; of a sudden turn only the smaller step counts, so that it takes place
    between the exposures.
    """
    if len(poses) < 2:
        return np.zeros((len(poses), 6))
    steps = se3.log(se3.inverse(poses[:-1]) @ poses[1:]) / period_s
    before, after = np.concatenate([steps[:1], steps]), np.concatenate([steps, steps[-1:]])
    sudden = np.linalg.norm(before[:, 3:] - after[:, 3:], axis=1) * period_s > MAX_CHANGE_RAD
    smaller = np.linalg.norm(before[:, 3:], axis=1) < np.linalg.norm(after[:, 3:], axis=1)
    one = np.where(smaller[:, None], before, after)
    return np.where(sudden[:, None], one, (before + after) / 2)
