"""Errors of an estimated trajectory against the truth, as `evo_ape` and `evo_rpe -d 1 -u f` define them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib import se3
from omnid.errors import OmnidError
from omnid.formats.tum import Trajectory, parts

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Metrics:
    """Errors over the associated poses after the alignment. NaN: undefined."""

    pairs: int  # associated poses
    coverage: float  # share of the truth's poses that have an estimate, 0..1
    length_estimate_m: float
    length_truth_m: float
    length_error_ratio: float  # (estimate - truth) / truth; negative: too short; NaN where the truth does not move
    ate_rmse_m: float  # absolute position error
    ate_max_m: float
    ate_aligned_m: float  # rmse of the positions after their best alignment; where it is small, the axes may differ
    end_error_m: float
    rpe_translation_rmse_m: float  # relative pose error from each associated pose to the next
    rpe_rotation_rmse_rad: float
    heading_rmse_rad: float  # yaw of R_truth^T R_estimate
    heading_max_rad: float
    heading_end_rad: float  # signed, positive: the estimate is rotated too far left

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
        ]
        if self.ate_rmse_m > 10 * self.ate_aligned_m:
            rows += [("", "most of the ATE is one rotation: is the truth of other axes? try `omnid eval --frame auto`")]
        return "\n".join(f"{name:<21} {value}" for name, value in rows)


def evaluate(estimate: Trajectory, truth: Trajectory, tolerance_s: float = 0.01, alignment: str = "origin") -> Metrics:
    """Compare an estimate with the truth, both T_world_rig of the same rig frame in any two worlds.

    alignment: "origin" or "rigid", see `aligned`. Raise OmnidError for fewer than two associated poses.
    """
    if alignment not in ("origin", "rigid"):
        raise OmnidError(f"an alignment origin or rigid was expected, {alignment!r} found")
    T_est, T_true = same_times(estimate, truth, tolerance_s)
    T_est = aligned(T_est, T_true, alignment)
    (_, est_xyz), (_, true_xyz) = parts(T_est), parts(T_true)
    position_m = np.linalg.norm(est_xyz - true_xyz, axis=1)
    heading_rad = se3.yaw(se3.inverse(T_true) @ T_est)
    est_steps, true_steps = (se3.inverse(T[:-1]) @ T[1:] for T in (T_est, T_true))
    step_R, step_xyz = parts(se3.inverse(true_steps) @ est_steps)
    est_m, true_m = (float(np.linalg.norm(np.diff(xyz, axis=0), axis=1).sum()) for xyz in (est_xyz, true_xyz))
    return Metrics(
        pairs=len(T_est),
        coverage=len(T_true) / truth.stamps_ns.size,
        length_estimate_m=est_m,
        length_truth_m=true_m,
        length_error_ratio=(est_m - true_m) / true_m if true_m > 0.0 else math.nan,
        ate_rmse_m=_rms(position_m),
        ate_max_m=float(position_m.max()),
        ate_aligned_m=_aligned_rms(est_xyz, true_xyz),
        end_error_m=float(position_m[-1]),
        rpe_translation_rmse_m=_rms(np.linalg.norm(step_xyz, axis=1)),
        rpe_rotation_rmse_rad=_rms(np.linalg.norm(se3.rotation_log(step_R), axis=1)),
        heading_rmse_rad=_rms(heading_rad),
        heading_max_rad=float(np.abs(heading_rad).max()),
        heading_end_rad=float(heading_rad[-1]),
    )


def same_times(estimate: Trajectory, truth: Trajectory, tolerance_s: float) -> tuple[Array, Array]:
    """Return poses (N, 4, 4) of an estimate, and those of the truth at the same times.

    Each estimate is associated with the truth nearest in time within the tolerance; of two estimates with the same
    truth, the nearer one. Raise OmnidError for fewer than two.
    """
    if not 0.0 <= tolerance_s < math.inf:
        raise OmnidError(f"a tolerance of 0 s or more was expected, {tolerance_s} found")
    of_estimate, of_truth = associate(estimate.stamps_ns, truth.stamps_ns, round(tolerance_s * 1e9))
    if of_estimate.size < 2:
        raise OmnidError(
            f"2 poses at the same times (within {tolerance_s:g} s) were expected, {of_estimate.size} found:"
            f" estimate {_span(estimate)}, truth {_span(truth)}: do both use the same clock?"
        )
    return estimate.T[of_estimate], truth.T[of_truth]


def body_rotation(estimate: Trajectory, truth: Trajectory, tolerance_s: float = 0.01) -> Array:
    """Return T_rig_body (4, 4) of a body at the rig's origin with other axes, as an IMU may have: a pure rotation.

    truth: trajectory of the body. The worlds are aligned by all positions; the rotation is the mean over the poses.
    """
    (R, xyz), (true_R, true_xyz) = map(parts, same_times(estimate, truth, tolerance_s))
    odom_truth, _ = Rotation.align_vectors(xyz - xyz.mean(axis=0), true_xyz - true_xyz.mean(axis=0))
    rig_body = Rotation.from_matrix(R.swapaxes(1, 2) @ odom_truth.as_matrix() @ true_R).mean()
    return se3.transform(rig_body.as_matrix(), np.zeros(3))


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


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _aligned_rms(xyz: Array, true_xyz: Array) -> float:
    """Return the rmse [m] of positions (N, 3) after the rotation and translation that make it smallest (Kabsch)."""
    xyz, true_xyz = xyz - xyz.mean(axis=0), true_xyz - true_xyz.mean(axis=0)
    shared = 2 * np.linalg.svd(xyz.T @ true_xyz, compute_uv=False).sum()
    return math.sqrt(max(0.0, float((xyz**2).sum() + (true_xyz**2).sum() - shared)) / len(xyz))


def aligned(T_est: Array, T_true: Array, alignment: str) -> Array:
    """Return the estimates (N, 4, 4) in the world of the truth, row by row at the same times.

    alignment: "origin": the first poses agree; "rigid": the positions agree best (least squares). Raise OmnidError for
    a path that is straight or shorter than three poses, which determines no rotation.
    """
    if alignment == "origin":
        return np.asarray(T_true[0] @ se3.inverse(T_est[0]) @ T_est)
    (est_R, est_xyz), (_, true_xyz) = parts(T_est), parts(T_true)
    from_middle = est_xyz - est_xyz.mean(axis=0)
    extents = np.linalg.svd(from_middle, compute_uv=False)
    if extents[1] <= 1e-3 * extents[0]:
        raise OmnidError(
            f"--align {alignment}: the associated positions lie on a line and determine no rotation; use --align origin"
        )
    R = Rotation.align_vectors(true_xyz - true_xyz.mean(axis=0), from_middle)[0].as_matrix()
    return se3.transform(R @ est_R, from_middle @ R.T + true_xyz.mean(axis=0))
