"""Location of a keyframe's new landmarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnid.core.odometry.exposure_times import NO_VELOCITY, AssumedMotion, RigVelocity
from omnid.core.odometry.new_landmarks import NewLandmarks
from tests.omnid.core.odometry.test_landmarks import views
from tests.omnid.core.odometry.test_late_depths import corrected

HEAVE = np.array([0.0, 0.0, 0.02, 0.0, 0.0, 0.0])  # m/s: 0.3 mm of 200 mm in 15 ms


TRUE = RigVelocity(np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.3]), 1e-6 * np.eye(6))


WRONG = RigVelocity(TRUE.twist + HEAVE, 4e-4 * np.eye(6))


def test_the_noise_of_new_views_contains_that_of_the_motion() -> None:
    exact = views(20)
    found, exposure = corrected(exact)
    noise = np.zeros((len(exact), 3, 3))
    new = NewLandmarks(
        exact[:, :2], found, np.zeros((len(exact), 2)), noise, AssumedMotion(WRONG, exposure.derivatives(found))
    )
    expected = exposure.corrected(exact[:, :2], found[:, 2])[1]
    np.testing.assert_allclose(new.whole_noise, expected, rtol=0.1, atol=1e-6)
    final = replace(new, assumed=AssumedMotion(NO_VELOCITY, np.zeros((len(exact), 3, 0))))
    np.testing.assert_array_equal(final.whole_noise, noise)
