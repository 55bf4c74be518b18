"""The bundle adjustment of the experiment finds poses that are hidden by noise, where views are exact."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.stereo.triangulation import view
from tests.experiments.windowed_bundle import Window, adjusted


def test_exact_views_give_exact_poses() -> None:
    rng, model = np.random.default_rng(1), StereoModel(Cylinder(1304, 378, 170.0), 0.24)
    points = rng.uniform([-3, -3, -1], [3, 3, 1], (80, 3))
    points[:, :2] += 1.5 * np.sign(points[:, :2])
    T = np.array([se3.exp([0.2 * k, 0.02 * k, 0, 0, 0, 0.1 * k]) for k in range(5)])
    views = np.concatenate([view(se3.apply(se3.inverse(one), points), model.cylinder, model.baseline_m) for one in T])
    noisy = np.array([T[0], *(one @ se3.exp(rng.normal(scale=0.01, size=6)) for one in T[1:])])
    near = points + rng.normal(scale=0.02, size=points.shape)
    window = Window(list(range(5)), noisy, near, np.tile(np.arange(80), 5),
                    np.repeat(np.arange(5), 80), views)
    np.testing.assert_allclose(adjusted(window, model), T, atol=1e-6)
