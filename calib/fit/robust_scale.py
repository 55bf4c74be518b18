"""Standard deviation of errors of which some are outliers."""

from __future__ import annotations

import numpy as np

from calib.models.camera import Array

# Ratio of the standard deviation to the median absolute deviation of a normal distribution.
SIGMA_PER_MAD = 1.4826
# Least standard deviation assumed for a coordinate: exact pixels would make the width of a robust function 0. Residual
# of what a model cannot project: larger than any residual in an image.
MIN_SIGMA_PX, LOST_PX = 0.01, 300.0


def robust_sigma(residual: Array) -> float:
    """Return the standard deviation of residuals by the median of their sizes (NaN: none), not less than the least."""
    return max(MIN_SIGMA_PX, SIGMA_PER_MAD * float(np.nanmedian(np.abs(residual))))
