"""Contradiction of a pose: where the base would be by wheels and gyro, where the images may be wrong.

A person who walks along with the base, or a rig of another size, gives poses whose images agree with each other. Their
covariance then says nothing of the error, but the other accounts of the motion do (motion_agreement.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.control.motion_monitor import Witness

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Contradiction:
    """The displacement from a pose by the images to the one by the other accounts.

    It stays in the covariance when the accounts agree again, since a later image does not mend a pose that went wrong.
    """

    T_odom_base: Array  # (4, 4) the pose by the images when it was last added to
    displacement: Array  # (6,) [t; r] [m; rad] from it to the other one, in its axes
    stamp_ns: int

    def at(self, T_odom_base: Array) -> Array:
        """Return the displacement (6,) from a later pose, in its axes."""
        return np.asarray(se3.adjoint(se3.inverse(T_odom_base) @ self.T_odom_base) @ self.displacement)

    def covariance(self, T_odom_base: Array) -> Array:
        """Return what it adds to the covariance (6, 6) of a later pose of the base, in the axes of the pose."""
        moved = self.at(T_odom_base)
        return np.outer(moved, moved)


def contradiction_after(
    before: Contradiction | None, witness: Witness, T_odom_base: Array, stamp_ns: int
) -> Contradiction | None:
    """Return the contradiction at a pose: that of before, with what the accounts differ by since then."""
    if not witness.contradicts_images or not (witness.distance.amount or witness.turn.amount):
        return before
    # The sums of the witness overlap from pair to pair: only their part since the last one is new.
    since_s = math.inf if before is None else (stamp_ns - before.stamp_ns) * 1e-9
    displacement = np.array([witness.distance.part(since_s), 0.0, 0.0, 0.0, 0.0, witness.turn.part(since_s)])
    if before is not None:
        displacement = displacement + before.at(T_odom_base)
    return Contradiction(T_odom_base, displacement, stamp_ns)
