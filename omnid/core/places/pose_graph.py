"""Pose graph on SE(3): sparse Gauss-Newton in which wrong loops lose their weight (graduated non-convexity).

Nodes are poses, edges are measured relative poses. Edges of the odometry are believed; each loop has a weight from 0 to
1 by the truncated least squares of Yang, Antonante, Tzoumas, Carlone 2020, "Graduated Non-Convexity for Robust Spatial
Perception" (GNC-TLS): the cost begins nearly convex, and a factor mu makes it steeper until every loop either counts in
full or not at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from calib import se3
from calib.fit.least_squares import MAX_STEPS

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

# Squared Mahalanobis distance of a right loop, because 99 % are below it (chi-squared, 6 dimensions).
LARGEST_SQUARED: Final = 16.8
# m and rad: a smaller step is the last one, once all weights are 0 or 1, because no map is so exact.
CONVERGED: Final = 1e-5
DAMPING: Final = 1e-6  # added to the diagonal, 1/m^2 and 1/rad^2, so that nodes which no edge holds stay where they are


@dataclass(frozen=True, slots=True)
class PoseEdges:
    """Measured poses of nodes b in nodes a, with the covariance [t; r] of small motions of b in its own axes."""

    pairs: Indices  # (M, 2) a, b
    T_a_b: Array  # (M, 4, 4)
    covariance: Array  # (M, 6, 6) positive definite
    is_loop: Flags  # (M,) True: may be wrong


@dataclass(frozen=True, slots=True)
class PoseGraphResult:
    """Poses after the optimisation, and the edges that agree with them."""

    poses: Array  # (N, 4, 4)
    accepted: Flags  # (M,) edges that agree
    # (6, 6) [t; r] of the last node in its axes, relative to the fixed ones; infinite if neither odometry nor accepted
    # loops join it to one of them.
    covariance: Array


def optimise(poses: Array, edges: PoseEdges, fixed: Flags | None = None) -> PoseGraphResult:
    """Return the poses (N, 4, 4) that best explain all edges, from a start.

    fixed: flags (N,) of the nodes that stay where they are, such as those of a saved map; None: the first node. Parts
    that no edge joins to a fixed node stay where they are.
    """
    if fixed is None:
        fixed = np.arange(len(poses)) == 0
    graph, loop, weights = _Graph(edges, fixed), edges.is_loop, np.ones(len(edges.pairs))
    residual, J = graph.linearised(poses)
    # With this factor the cost is convex for the largest of the squared residuals.
    largest = float((residual[loop] ** 2).sum(axis=1).max(initial=0.0))
    mu = LARGEST_SQUARED / max(2 * largest - LARGEST_SQUARED, LARGEST_SQUARED)
    for _ in range(MAX_STEPS):
        # 1. The weights of the loops at this mu; 2. one step of Gauss-Newton; 3. a steeper cost.
        ratio = np.sqrt(LARGEST_SQUARED / np.maximum((residual[loop] ** 2).sum(axis=1), 1e-12))
        weights[loop] = np.clip(ratio * np.sqrt(mu * (mu + 1)) - mu, 0.0, 1.0)
        change = graph.solve(residual, J, weights)
        poses = poses @ se3.exp(change)
        residual, J = graph.linearised(poses)
        is_decided = bool(np.isin(weights, (0, 1)).all())
        if is_decided and float(np.abs(change).max()) < CONVERGED:
            break
        mu *= 2  # Yang et al. take 1.4
    accepted = weights > 0.5  # the middle decides, because weights end at 0 or 1
    parts = connected(range(len(poses)), edges.pairs[accepted])
    last = next(part for part in parts if part[-1] + 1 == len(poses))
    is_joined = fixed[last].any()
    return PoseGraphResult(poses, accepted, graph.last_covariance(J, weights) if is_joined else np.full((6, 6), np.inf))


class _Graph:
    """The linear system of the edges; fixed nodes do not move."""

    def __init__(self, edges: PoseEdges, fixed: Flags) -> None:
        self._edges = edges
        self._W = np.linalg.inv(np.linalg.cholesky(edges.covariance))  # W S W^T = I
        self._moves = ~fixed
        self._fixed = scipy.sparse.diags(np.repeat(np.where(fixed, 1.0, DAMPING), 6))

    def linearised(self, T: Array) -> tuple[Array, Array]:
        """Return whitened residuals (M, 6), and their derivatives (M, 2, 6, 6) by small motions of the nodes a and b.

        The residual of an edge is W log(T_a_b^-1 T_a^-1 T_b), and a node moves by T exp(x); fixed nodes do not.
        """
        pairs, W = self._edges.pairs, self._W
        T_b_a = se3.inverse(T[pairs[:, 1]]) @ T[pairs[:, 0]]
        residual = se3.log(se3.inverse(T_b_a @ self._edges.T_a_b))
        by_b = W @ _inverse_right_jacobian(residual)
        J = np.stack([-by_b @ se3.adjoint(T_b_a), by_b], axis=1) * self._moves[pairs][..., None, None]
        return (W @ residual[..., None])[..., 0], J

    def solve(self, residual: Array, J: Array, weight: Array) -> Array:
        """Return the small motions (N, 6) of Gauss-Newton."""
        stacked, factorised = self._factorised(J, weight)
        gradient = stacked.T @ (np.sqrt(weight)[:, None] * residual).ravel()
        return np.asarray(-factorised.solve(gradient)).reshape(-1, 6)

    def last_covariance(self, J: Array, weight: Array) -> Array:
        """Return the covariance (6, 6) of the last node: a block of the inverse of the normal equations."""
        if not self._moves[-1]:
            return np.zeros((6, 6))
        columns = np.zeros((6 * len(self._moves), 6))
        columns[-6:] = np.eye(6)
        found = self._factorised(J, weight)[1].solve(columns)[-6:]
        return np.asarray((found + found.T) / 2)

    def _factorised(self, J: Array, weight: Array) -> tuple[Any, Any]:
        """Return the weighted derivatives as a sparse matrix (6 M, 6 N), and the factorised normal equations."""
        from scipy.sparse.linalg import splu  # scipy itself loads no packages in packages when they are used

        count = len(weight)
        blocks = (np.sqrt(weight)[:, None, None, None] * J).reshape(-1, 6, 6)
        stacked = scipy.sparse.bsr_matrix(
            (blocks, self._edges.pairs.ravel(), 2 * np.arange(count + 1)), shape=(6 * count, 6 * len(self._moves))
        )
        return stacked, splu(
            scipy.sparse.csc_matrix(stacked.T @ stacked + self._fixed),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            relax=6,
            panel_size=6,  # blocks of 6 x 6
            options={"SymmetricMode": True},
        )


def _inverse_right_jacobian(xi: Array) -> Array:
    """Return the derivative (M, 6, 6) of log(exp(xi) exp(x)) by x at 0: its series up to the second order."""
    ad = np.zeros((len(xi), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = se3.hat(xi[:, 3:])
    ad[:, :3, 3:] = se3.hat(xi[:, :3])
    return np.asarray(np.eye(6) + ad / 2 + ad @ ad / 12)


def connected(ids: Sequence[int], pairs: ArrayLike) -> list[list[int]]:
    """Return the parts of a graph that pairs (K, 2) of its ids join, each ascending, the largest part first."""
    nodes = np.array(sorted(ids), np.intp)
    rows = np.searchsorted(nodes, np.asarray(pairs, np.intp).reshape(-1, 2))
    joins = scipy.sparse.coo_matrix((np.ones(len(rows)), tuple(rows.T)), (len(nodes), len(nodes)))
    count, label = scipy.sparse.csgraph.connected_components(joins, directed=False)
    parts = [nodes[label == part].tolist() for part in range(count)]
    return sorted(parts, key=lambda part: (-len(part), part[0]))
