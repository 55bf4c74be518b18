"""Errors of an estimated trajectory against the truth, as `evo_ape` and `evo_rpe -d 1 -u f` define them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.errors import OmnidError
from omnid.formats.tum import Trajectory, parts

Array = NDArray[np.float64]
ALIGNMENTS: Final = ("origin", "rigid", "scale")
_LEAST_SPREAD: Final = 1e-3  # second extent of the path, as a fraction of the first, that determines a rotation


@dataclass(frozen=True, slots=True)
class Metrics:
    """Errors over the associated poses after the alignment. NaN: undefined."""

    pairs: int  # associated poses
    coverage: float  # share of the truth's poses that have an estimate, 0..1
    length_estimate_m: float
    length_truth_m: float
    length_error_ratio: float  # (estimate - truth) / truth; negative: too short; NaN where the truth stands still
    ate_rmse_m: float  # absolute position error
    ate_max_m: float
    end_error_m: float
    rpe_translation_rmse_m: float  # relative pose error from each associated pose to the next
    rpe_rotation_rmse_rad: float
    heading_rmse_rad: float  # yaw of R_truth^T R_estimate
    heading_max_rad: float
    heading_end_rad: float  # signed, positive: the estimate is rotated too far left
    scale: float  # factor of the estimate's positions by the alignment "scale"; otherwise 1

    def __str__(self) -> str:
        """Return aligned lines for a terminal, in m, mm, per cent and degrees."""
        ratio = self.length_error_ratio
        error = "undefined" if math.isnan(ratio) else f"{100.0 * ratio:+.2f} %"
        length = f"{self.length_estimate_m:.4f} m, truth {self.length_truth_m:.4f} m ({error})"
        errors_mm = (1e3 * v for v in (self.ate_rmse_m, self.ate_max_m, self.end_error_m))
        position = "rmse {:.2f}, max {:.2f}, end {:.2f} mm".format(*errors_mm)
        errors_deg = (math.degrees(v) for v in (self.heading_rmse_rad, self.heading_max_rad, self.heading_end_rad))
        heading = "rmse {:.3f}, max {:.3f}, end {:.3f} deg".format(*errors_deg)
        step_mm, step_deg = 1e3 * self.rpe_translation_rmse_m, math.degrees(self.rpe_rotation_rmse_rad)
        rows = [
            ("associated poses", f"{self.pairs} ({self.coverage:.1%} of the truth)"),
            ("path length", length),
            ("position error (ATE)", position),
            ("heading error", heading),
            ("step error (RPE)", f"rmse {step_mm:.2f} mm, {step_deg:.3f} deg"),
            *([("scale", f"estimate times {self.scale:.5f}")] if self.scale != 1.0 else []),
        ]
        return "\n".join(f"{name:<21} {value}" for name, value in rows)


def evaluate(estimate: Trajectory, truth: Trajectory, tolerance_s: float = 0.01, alignment: str = "origin") -> Metrics:
    """Compare an estimate with the truth, both T_world_rig of the same rig frame in any two worlds.

    alignment: one of ALIGNMENTS, see `aligned`.

    Each estimate is associated with the truth nearest in time within the tolerance; of two estimates with the same
    truth, the nearer one. Raise OmnidError for fewer than two associated poses.
    """
    if alignment not in ALIGNMENTS or not 0.0 <= tolerance_s < math.inf:
        expected = f"an alignment {', '.join(ALIGNMENTS)} and a tolerance of 0 s or more"
        raise OmnidError(f"{expected} were expected, {alignment!r} and {tolerance_s} found")
    of_estimate, of_truth = associate(estimate.stamps_ns, truth.stamps_ns, round(tolerance_s * 1e9))
    if of_estimate.size < 2:
        raise OmnidError(
            f"2 poses at the same times (within {tolerance_s:g} s) were expected, {of_estimate.size} found:"
            f" estimate {_span(estimate)}, truth {_span(truth)}: do both use the same clock?"
        )
    T_true = truth.T[of_truth]
    return _metrics(*aligned(estimate.T[of_estimate], T_true, alignment), T_true, len(T_true) / truth.stamps_ns.size)


def associate(
    stamps_ns: NDArray[np.int64], true_ns: NDArray[np.int64], tolerance_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return indices (of the estimate, of the truth) of the associated poses, in time order, each at most once."""
    if not stamps_ns.size or not true_ns.size:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    after = np.clip(np.searchsorted(true_ns, stamps_ns), 0, true_ns.size - 1)
    before = np.maximum(after - 1, 0)
    earlier = np.abs(stamps_ns - true_ns[before]) <= np.abs(true_ns[after] - stamps_ns)
    nearest = np.where(earlier, before, after).astype(np.int64)
    gap_ns = np.abs(stamps_ns - true_ns[nearest])
    near = np.flatnonzero(gap_ns <= tolerance_ns)
    best_first = near[np.lexsort((near, gap_ns[near]))]
    of_truth, first = np.unique(nearest[best_first], return_index=True)
    return best_first[first], of_truth


def _span(trajectory: Trajectory) -> str:
    stamps_ns = trajectory.stamps_ns
    return f"spans {stamps_ns[0] / 1e9:.3f} to {stamps_ns[-1] / 1e9:.3f} s" if stamps_ns.size else "holds no pose"


def _metrics(T_est: Array, scale: float, T_true: Array, coverage: float) -> Metrics:
    """Return metrics of poses (N, 4, 4), row by row at the same time and in the same world."""
    (_, est_xyz), (_, true_xyz) = parts(T_est), parts(T_true)
    position_m = np.linalg.norm(est_xyz - true_xyz, axis=1)
    heading_rad = se3.yaw(se3.inverse(T_true) @ T_est)
    est_steps, true_steps = (se3.inverse(T[:-1]) @ T[1:] for T in (T_est, T_true))
    step_R, step_xyz = parts(se3.inverse(true_steps) @ est_steps)
    est_m, true_m = (float(np.linalg.norm(np.diff(xyz, axis=0), axis=1).sum()) for xyz in (est_xyz, true_xyz))
    return Metrics(
        pairs=len(T_est),
        coverage=coverage,
        length_estimate_m=est_m,
        length_truth_m=true_m,
        length_error_ratio=(est_m - true_m) / true_m if true_m > 0.0 else math.nan,
        ate_rmse_m=_rms(position_m),
        ate_max_m=float(position_m.max()),
        end_error_m=float(position_m[-1]),
        rpe_translation_rmse_m=_rms(np.linalg.norm(step_xyz, axis=1)),
        rpe_rotation_rmse_rad=_rms(np.linalg.norm(se3.rotation_log(step_R), axis=1)),
        heading_rmse_rad=_rms(heading_rad),
        heading_max_rad=float(np.abs(heading_rad).max()),
        heading_end_rad=float(heading_rad[-1]),
        scale=scale,
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def rotation_between(a: Array, b: Array) -> tuple[Array, Array]:
    """Return the rotation R (3, 3) with b = R a for vectors (N, 3), by least squares, and how far it is determined.

    Kabsch's method: the second result (3,) holds the singular values of the covariance of both, the largest first, with
    the sign of the reflection that was excluded.
    """
    U, spread, Vt = np.linalg.svd(b.T @ a / len(a))
    signs = np.sign([1.0, 1.0, np.linalg.det(U @ Vt)])
    return np.asarray(U * signs @ Vt), spread * signs


def aligned(T_est: Array, T_true: Array, alignment: str) -> tuple[Array, float]:
    """Return the estimates (N, 4, 4) in the world of the truth, row by row at the same times, and their scale.

    alignment: "origin": the first poses agree; "rigid": the positions agree best (least squares); "scale": these after
    the estimate is scaled as well (Umeyama 1991). Raise OmnidError for a path that is straight or shorter than three
    poses, which determines no rotation.
    """
    if alignment == "origin":
        return np.asarray(T_true[0] @ se3.inverse(T_est[0]) @ T_est), 1.0
    (est_R, est_xyz), (_, true_xyz) = parts(T_est), parts(T_true)
    from_middle = est_xyz - est_xyz.mean(axis=0)
    R, spread = rotation_between(from_middle, true_xyz - true_xyz.mean(axis=0))
    if len(T_true) <= 2 or spread[1] <= _LEAST_SPREAD**2 * spread[0]:
        raise OmnidError(
            f"--align {alignment}: the associated positions lie on a line and determine no rotation; use --align origin"
        )
    scale = float(spread.sum() / np.square(from_middle).sum(axis=1).mean()) if alignment == "scale" else 1.0
    return se3.transform(R @ est_R, scale * from_middle @ R.T + true_xyz.mean(axis=0)), scale
