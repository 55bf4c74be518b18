"""Standard deviation of errors of which some are outliers."""

from __future__ import annotations

import numpy as np
import pytest

from calib.fit.robust_scale import robust_sigma


def test_the_robust_sigma_is_that_of_most_residuals() -> None:
    residual = np.random.default_rng(3).normal(0.0, 0.2, 20_000)
    residual[:1000], residual[1000:2000] = 50.0, np.nan
    assert robust_sigma(residual, 0.01) == pytest.approx(0.2, rel=0.1)
    assert robust_sigma(np.zeros(5), 0.01) == 0.01
