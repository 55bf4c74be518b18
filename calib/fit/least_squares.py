"""Robust nonlinear least squares with many small unknowns of their own: the search of all bundle adjustments.

A bundle adjustment has common unknowns (cameras) and many blocks of unknowns (poses of boards, landmarks) that meet
only in the common ones. Their normal equations have arrow structure: the blocks are eliminated (Schur complement), and
a system of the size of the common unknowns is solved (Triggs et al. 2000, section 6). The search is that of Levenberg
and Marquardt with Marquardt's scaling.

scipy.optimize.least_squares cannot replace it: its robust losses weigh coordinates and not the length of a residual
(x, y), its dense solver takes seven times as long for 40 views of a board, and its sparse one (lsmr) had not converged
after 60 evaluations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
import scipy

from calib.models.camera import Array

# The damping at the start takes a nearly undamped step. It changes by a power of ten after each step (Marquardt 1963).
# Below the least value a step is in effect undamped, above the largest one it is lost in rounding.
START_DAMPING, DAMPING_FACTOR = 1e-4, 10.0
MIN_DAMPING, MAX_DAMPING = 1e-9, 1e8
# Width of robust functions in standard deviations of a coordinate: of normal errors 86 % of the efficiency of least
# squares remains with the weights of Geman and McClure 1987, more with those of Huber and Cauchy.
KERNEL_WIDTH = 2.5
MAX_STEPS = 60  # of a search, a bound that is never reached by good data
# Rounds of an estimate whose data or weights depend on its own result.
ROUNDS = 3

# The best step of central differences of a smooth function of about unit size: the cube root of a double's rounding.
BEST_STEP = float(np.finfo(float).eps ** (1 / 3))

State = TypeVar("State")


@dataclass(frozen=True, slots=True)
class ArrowSystem:
    """Normal equations [[A, B], [B^T, C]] [common; blocks] = [a; c] with K blocks of D unknowns, C block diagonal."""

    A: Array  # (P, P)
    B: scipy.sparse.csr_matrix | Array  # (P, K D); an array where each block meets most common unknowns
    C: Array  # (K, D, D)
    a: Array  # (P,)
    c: Array  # (K D,)

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return the damped steps of the common unknowns (P,) and of the blocks (K, D)."""
        inverse = self.inverse_blocks(damping)
        common = np.asarray(np.linalg.solve(*self._reduced_by(inverse, damping)))
        return common, np.asarray(inverse @ (self.c - self.B.T @ common)).reshape(len(self.C), -1)

    def reduced(self) -> tuple[Array, Array]:
        """Return the system (P, P) and its right side (P,) of the common unknowns, without damping."""
        return self._reduced_by(self.inverse_blocks(), 0.0)

    def inverse_blocks(self, damping: float = 0.0) -> scipy.sparse.csr_matrix:
        """Return the inverse (K D, K D) of the damped blocks."""
        K, D, _ = self.C.shape
        # A block without observations stays invertible, by far less than the information of any observation.
        damped = self.C * (1 + damping * np.eye(D)) + MIN_DAMPING * np.eye(D)
        return scipy.sparse.bsr_matrix((np.linalg.inv(damped), np.arange(K), np.arange(K + 1)), (K * D, K * D)).tocsr()

    def _reduced_by(self, inverse: scipy.sparse.csr_matrix, damping: float) -> tuple[Array, Array]:
        between = self.B @ inverse
        damped = self.A + damping * np.diag(np.diag(self.A))
        share = between @ self.B.T
        by_blocks = share.toarray() if scipy.sparse.issparse(share) else share
        return damped - by_blocks, np.asarray(self.a - between @ self.c)


class Problem(Protocol[State]):
    """The objective: a sum of robust functions of residuals, and the system that approximates it."""

    def scale(self, state: State) -> float:
        """Return the scale of the robust function at a state."""

    def cost(self, state: State, scale: float) -> float:
        """Return the cost of a state for a scale."""

    def normal_equations(self, state: State, scale: float) -> ArrowSystem:
        """Return the normal equations at a state, residuals weighted by the robust function."""

    def moved(self, state: State, common: Array, blocks: Array) -> State | None:
        """Return the state after steps (P,) and (K, D); None if there is no such camera."""


def minimise(
    problem: Problem[State], state: State, gain: float, damping: float = START_DAMPING, last_damping: float = np.inf
) -> State:
    """Return the state of least cost near the one given (Levenberg and Marquardt).

    It ends after a step of a relative gain below `gain` with a damping below last_damping: a damped step follows the
    steep directions only, so that where flat ones count, the last step needs little damping. damping: of the first
    step; one next to the minimum needs hardly any.
    """
    for _ in range(MAX_STEPS):
        # 1. Linearise at the state, with the scale of its residuals.
        scale = problem.scale(state)
        cost, system = problem.cost(state, scale), problem.normal_equations(state, scale)
        # 2. Raise the damping until a step leads to a camera, and lowers the cost.
        while True:
            try:
                trial = problem.moved(state, *system.step(damping))
            except np.linalg.LinAlgError:
                trial = None
            if trial is not None and (trial_cost := problem.cost(trial, scale)) < cost:
                break
            damping *= DAMPING_FACTOR
            if damping > MAX_DAMPING:
                return state
        # 3. Take the step. End if it gained little, else lower the damping.
        state = trial
        if cost - trial_cost < gain * cost and damping < last_damping:
            return state
        damping = max(MIN_DAMPING, damping / DAMPING_FACTOR)
    return state


def central_differences(function: Callable[[Array], Array], steps: Array) -> Array:
    """Return the derivatives (..., P) of a function about zero, by steps (P,) of its argument."""
    return np.stack([(function(step) - function(-step)) / (2 * np.abs(step).max()) for step in np.diag(steps)], axis=-1)


# Ratio of the standard deviation to the median absolute deviation of a normal distribution.
SIGMA_PER_MAD = 1.4826


def robust_sigma(residual: Array) -> float:
    """Return the standard deviation [px] of residuals (NaN: none) by their median size; above 0 for exact ones."""
    return max(BEST_STEP, SIGMA_PER_MAD * float(np.nanmedian(np.abs(residual))))
