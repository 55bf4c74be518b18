"""The experiment on noise as a mixture: its weights, and the kernel is put back."""

from __future__ import annotations

from omnid.core.odometry import pose_kernels
from tests.experiments.mixture_noise import KERNELS, WIDTH, errors, kernel, mixture_weight


def test_the_mixture_has_two_weights_and_the_nearer_component_wins() -> None:
    assert [mixture_weight(squared) for squared in (0.0, 9.0, 25.0, 1e4)] == [1.0, 1.0, WIDTH**-2, WIDTH**-2]


def test_the_kernel_is_put_back() -> None:
    before = pose_kernels.gauss_newton
    with kernel(mixture_weight):
        assert pose_kernels.gauss_newton is not before
    assert pose_kernels.gauss_newton is before


def test_among_people_the_mixture_is_worse() -> None:
    by_cauchy, by_mixture = (errors("crowded", KERNELS[name], runs=25) for name in ("Cauchy", "mixture"))
    assert by_mixture[1] > 1.5 * by_cauchy[1] and by_mixture[2] > 3 * by_cauchy[2]
    assert errors("clean", KERNELS["Cauchy"], runs=25)[2] < 9
