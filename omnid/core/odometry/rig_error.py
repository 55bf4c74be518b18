"""What the calibration leaves open, in the covariance of the pose: the errors of the rig are consider states.

Schmidt's consider filter (Tapley, Schutz, Born, Statistical Orbit Determination, 2004, section 6): parameters that are
not estimated keep their covariance, and the pose inherits it. A rig is wrong in the same way in all steps: a baseline
that is 0.2 % too long makes each step 0.2 % too long. So errors of steps add up along the path, not their variances,
and a way back takes off what the way there has added.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.fit.rig_uncertainty import MotionErrors

Array = NDArray[np.float64]


class RigError:
    """Derivatives of the pose by the errors of the rig, along the path of a run."""

    def __init__(self, errors: MotionErrors) -> None:
        self._errors = errors
        self._T_odom_rect = np.eye(4)
        self._G = np.zeros((6, errors.constant.shape[2]))

    def at(self, T_odom_rect: Array, distance_m: float) -> Array:
        """Return the covariance (6, 6) [t; r] at the next pose (4, 4), in the axes of the rectified frame.

        distance_m: median distance of the landmarks that the step was measured by.
        """
        # 1. The step, and what its measurement is wrong by: J(xi) = sum_d xi_d J_d.
        step = se3.log(se3.inverse(self._T_odom_rect) @ T_odom_rect)
        of_step = np.einsum("edk,d->ek", self._errors.at(distance_m), step)
        # 2. G <- Ad(exp(-xi / 2)) (Ad(exp(-xi / 2)) G + J(xi)): the error of a step arises in its middle, so that the
        #    same step back takes it off. The K errors are independent, and of one sigma each.
        half = se3.adjoint(se3.exp(-0.5 * step))
        self._G = half @ (half @ self._G + of_step)
        self._T_odom_rect = T_odom_rect
        return np.asarray(self._G @ self._G.T)
