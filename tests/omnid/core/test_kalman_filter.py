"""filterpy's filter without the rest of filterpy: the same numbers, and what is not imported."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from omnid.core.kalman_filter import kalman_filter


def test_the_filter_is_that_of_filterpy() -> None:
    from filterpy.kalman import KalmanFilter  # here, because it loads scipy.stats, which no other test needs

    ours, theirs = kalman_filter(dim_x=4, dim_z=2), KalmanFilter(dim_x=4, dim_z=2)
    for one in (ours, theirs):
        random = np.random.default_rng(0)
        one.H = random.normal(size=(2, 4))
        for _ in range(5):
            one.predict(F=np.eye(4) + 0.1 * random.normal(size=(4, 4)), Q=np.eye(4))
            one.update(random.normal(size=(2, 1)), R=np.eye(2))
    assert ours.x.any()
    assert np.array_equal(ours.x, theirs.x) and np.array_equal(ours.P, theirs.P)


def test_a_run_begins_without_scipy_packages() -> None:
    program = (
        "import sys, omnid.runs.replay\n"
        "from omnid.core.kalman_filter import kalman_filter\n"
        "kalman_filter(2, 1).predict()\n"
        "slow = ('filterpy', 'matplotlib', 'scipy.sparse', 'scipy.spatial', 'scipy.special', 'scipy.stats')\n"
        "print([name for name in slow if name in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
