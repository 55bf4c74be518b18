"""Limits of the odometry."""

from __future__ import annotations

import pytest

from omnid.core.odometry.limits import OdometryLimits
from omnid.errors import OmnidError


@pytest.mark.parametrize(("features", "min_inliers"), [(500, 10_000), (20, 20)])
def test_more_inliers_than_landmarks_are_refused(features: int, min_inliers: int) -> None:
    """Else every pose is refused, and the run is lost from its first pair to its last."""
    with pytest.raises(
        OmnidError, match=rf"odometry.limits.min_inliers is {min_inliers}: expected less than odometry.limits.features"
    ):
        OdometryLimits(features=features, min_inliers=min_inliers)
    assert OdometryLimits(features=min_inliers + 1, min_inliers=min_inliers).features > min_inliers
