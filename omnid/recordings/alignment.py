"""Alignment of a trajectory with the truth by all positions: Umeyama 1991, IEEE PAMI 13(4), eq. (40) to (43)."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.errors import OmnidError

Array = NDArray[np.float64]

ALIGNMENTS: Final = ("origin", "rigid", "scale")
_LEAST_SPREAD: Final = 1e-3  # second extent of the path, in parts of the first, that determines a rotation


def aligned(T_est: Array, T_true: Array, alignment: str) -> Array:
    """Return the estimates (N, 4, 4) in the world of the truth, row by row at the same times.

    alignment: "origin": the first poses agree; "rigid": the positions agree best (least squares); "scale": these after
    the estimate is scaled as well. Raise OmnidError for a path that is straight or shorter than three poses, which
    determines no rotation.
    """
    if alignment == "origin":
        return np.asarray(T_true[0] @ se3.inverse(T_est[0]) @ T_est)
    estimate, truth = T_est[:, :3, 3], T_true[:, :3, 3]
    middle_est, middle_true = estimate.mean(axis=0), truth.mean(axis=0)
    covariance = (truth - middle_true).T @ (estimate - middle_est) / len(truth)
    U, spread, Vt = np.linalg.svd(covariance)
    if len(truth) < 3 or spread[1] <= _LEAST_SPREAD**2 * spread[0]:
        raise OmnidError(
            f"--align {alignment}: the associated positions lie on a line and determine no rotation; use --align origin"
        )
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U * signs @ Vt
    variance = float(((estimate - middle_est) ** 2).sum() / len(truth))
    scale = float(spread @ signs) / variance if alignment == "scale" else 1.0
    T = T_est.copy()
    T[:, :3, :3] = R @ T_est[:, :3, :3]
    T[:, :3, 3] = scale * (estimate - middle_est) @ R.T + middle_true
    return T
