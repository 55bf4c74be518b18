"""The experiment on noise as a mixture: its weights, and the kernel is put back."""

from __future__ import annotations

import numpy as np

from omnid.core.odometry import pose_estimation
from tests.experiments.mixture_noise import KERNELS, WIDTH, errors, kernel, mixture_weight


def test_the_mixture_has_two_weights_and_the_nearer_component_wins() -> None:
    weights = mixture_weight(np.array([0.0, 9.0, 25.0, 1e4]))
    np.testing.assert_array_equal(weights, [1.0, 1.0, WIDTH**-2, WIDTH**-2])


def test_the_kernel_is_put_back() -> None:
    before = pose_estimation.robust_weight
    with kernel(mixture_weight):
        assert pose_estimation.robust_weight is mixture_weight
    assert pose_estimation.robust_weight is before


def test_among_people_the_mixture_is_worse() -> None:
    by_cauchy, by_mixture = (errors("crowded", KERNELS[name], runs=25) for name in ("Cauchy", "mixture"))
    assert by_mixture[1] > 1.5 * by_cauchy[1] and by_mixture[2] > 3 * by_cauchy[2]
    assert errors("clean", KERNELS["Cauchy"], runs=25)[2] < 9
