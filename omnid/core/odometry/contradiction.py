"""Contradiction of a pose: the base is elsewhere by wheels and gyro, and the images may be wrong.

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
    """Displacements (6,) [t; r] [m; rad] from a pose by the images to the one by the other accounts, in its axes.

    What they differed by in a fault stays when they agree again, since a later image does not mend a pose that went
    wrong. A doubt is over with its reason.
    """

    T_odom_base: Array  # (4, 4) the pose by the images
    faults: Array
    doubt: Array
    fault_s: float  # time of the last fault

    def covariance(self) -> Array:
        """Return what it adds to the covariance (6, 6) of the pose, in its axes."""
        displacement = self.faults + self.doubt
        return np.outer(displacement, displacement)


def contradiction_after(
    before: Contradiction | None, witness: Witness, T_odom_base: Array, time_s: float
) -> Contradiction | None:
    """Return the contradiction at a pose: that of before, with what the accounts differ by since then."""
    if before is None and not witness.contradicts_images:
        return None
    faults, fault_s, doubt = np.zeros(6), -math.inf, np.zeros(6)
    if before is not None:
        moved = se3.adjoint(se3.inverse(T_odom_base) @ before.T_odom_base)
        faults, fault_s = moved @ before.faults, before.fault_s
    if witness.contradicts_images and witness.is_fault:
        # The sums of the witness overlap from pair to pair: only their part since the last fault is new.
        faults, fault_s = faults + _displacement(witness, time_s - fault_s), time_s
    elif witness.contradicts_images:
        doubt = _displacement(witness, time_s - fault_s)
    return Contradiction(T_odom_base, faults, doubt, fault_s)


def _displacement(witness: Witness, seconds: float) -> Array:
    """Return how much farther the base is by the others (6,), by the newest so many seconds.

    Ways and turns in them are so short that their order does not matter.
    """
    return np.array([witness.distance.part(seconds), 0.0, 0.0, 0.0, 0.0, witness.turn.part(seconds)])
