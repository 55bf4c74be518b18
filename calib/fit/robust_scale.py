"""Standard deviation of errors of which some are outliers."""

from __future__ import annotations

import numpy as np

from calib.models.camera import Array

# Ratio of the standard deviation to the median absolute deviation of a normal distribution.
SIGMA_PER_MAD = 1.4826


def robust_sigma(residual: Array, least: float) -> float:
    """Return the standard deviation of residuals by the median of their sizes (NaN: none), not less than `least`."""
    return max(least, SIGMA_PER_MAD * float(np.nanmedian(np.abs(residual))))
