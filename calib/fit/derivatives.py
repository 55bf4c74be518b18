"""Numeric derivatives."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.models.camera import Array


def central_differences(function: Callable[[Array], Array], steps: Array) -> Array:
    """Return the derivatives (..., P) of a function about zero, by steps (P,) of its argument."""
    return np.stack([(function(step) - function(-step)) / (2 * np.abs(step).max()) for step in np.diag(steps)], axis=-1)
