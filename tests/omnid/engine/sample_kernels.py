"""A compiled function for the tests of the cache."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled


@compiled("(f8[::1], f8[::1])", writes=("out",))
def halves(values: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Write half of each value."""
    for n in range(len(values)):
        out[n] = values[n] / 2
