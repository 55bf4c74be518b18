"""The search of all bundle adjustments: elimination of blocks, damping, ends, robust scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import sparse

from calib.fit.least_squares import ArrowSystem, Ending, minimise
from calib.models.camera import Array

COMMON, BLOCKS, SIZE = 4, 6, 3
ENDING = Ending(steps=60, gain=1e-12)


def system(seed: int) -> tuple[ArrowSystem, Array, Array]:
    """Return a random system, and the same one as a dense matrix and right side."""
    rng = np.random.default_rng(seed)
    J = np.zeros((BLOCKS, 8, COMMON + BLOCKS * SIZE))
    for k in range(BLOCKS):
        J[k, :, :COMMON] = rng.standard_normal((8, COMMON))
        J[k, :, COMMON + k * SIZE : COMMON + (k + 1) * SIZE] = rng.standard_normal((8, SIZE))
    flat = J.reshape(-1, J.shape[2])
    H, g = flat.T @ flat, flat.T @ rng.standard_normal(len(flat))
    blocks = np.array([H[at : at + SIZE, at : at + SIZE] for at in range(COMMON, len(H), SIZE)])
    arrow = ArrowSystem(H[:COMMON, :COMMON], sparse.csr_matrix(H[:COMMON, COMMON:]), blocks, g[:COMMON], g[COMMON:])
    return arrow, H, g


@pytest.mark.parametrize("damping", [0.0, 1e-4, 10.0])
def test_a_step_is_that_of_the_whole_system(damping: float) -> None:
    arrow, H, g = system(1)
    expected = np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
    common, blocks = arrow.step(damping)
    np.testing.assert_allclose(common, expected[:COMMON], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(blocks.ravel(), expected[COMMON:], rtol=1e-7, atol=1e-9)


def test_the_reduced_system_has_the_covariance_of_the_common_unknowns() -> None:
    arrow, H, g = system(2)
    S, s = arrow.reduced()
    np.testing.assert_allclose(np.linalg.inv(S), np.linalg.inv(H)[:COMMON, :COMMON], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(np.linalg.solve(S, s), np.linalg.solve(H, g)[:COMMON], rtol=1e-7, atol=1e-9)


@dataclass(frozen=True, slots=True)
class Decay:
    """Amplitudes, one block each, times one common decay: y = amplitude exp(-rate t); rates below 0 are refused."""

    t: Array
    y: Array  # (K, T)

    def residuals(self, state: Array) -> Array:
        return np.asarray(self.y - state[1:, None] * np.exp(-state[0] * self.t))

    def scale(self, state: Array) -> float:
        return 1.0

    def cost(self, state: Array, scale: float) -> float:
        return float((self.residuals(state) ** 2).sum())

    def moved(self, state: Array, common: Array, blocks: Array) -> Array | None:
        moved = state + np.concatenate([common, blocks.ravel()])
        return moved if moved[0] > 0 else None

    def normal_equations(self, state: Array, scale: float) -> ArrowSystem:
        decay, r = np.exp(-state[0] * self.t), self.residuals(state)
        by_rate, by_amplitude = -state[1:, None] * self.t * decay, np.tile(decay, (len(self.y), 1))
        return ArrowSystem(
            np.array([[(by_rate**2).sum()]]),
            sparse.csr_matrix((by_rate * by_amplitude).sum(axis=1)),
            (by_amplitude**2).sum(axis=1)[:, None, None],
            np.array([(by_rate * r).sum()]),
            (by_amplitude * r).sum(axis=1),
        )


def test_finds_the_minimum_from_a_start_at_which_full_steps_fail() -> None:
    truth, t = np.array([1.7, 2.0, -0.6, 5.0]), np.linspace(0, 3, 40)
    problem = Decay(t, truth[1:, None] * np.exp(-truth[0] * t))
    start = np.array([9.0, 0.1, 0.1, 0.1])
    assert problem.moved(start, *problem.normal_equations(start, 1.0).step(0.0)) is None
    np.testing.assert_allclose(minimise(problem, start, ENDING), truth, rtol=1e-6)
