"""Comparison of the recorded path with the true one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.formats.tum import Trajectory
from omnid.recordings.evaluation import Metrics, evaluate
from omnid.report.downsampling import Corner, Downsampled, Point, path_trace
from omnid.report.poses import PoseHistory

Array = NDArray[np.float64]
TOLERANCE_S: Final = 0.01


@dataclass(frozen=True, slots=True)
class TruthComparison:
    """Errors of the rig's poses; only the first pose is aligned."""

    metrics: Metrics
    path: list[Point]  # x, y of the base on its true path, in odom
    position_m: Downsampled
    heading_rad: Downsampled


def compare_with_truth(poses: PoseHistory, T_base_rig: Array, truth: Trajectory) -> TruthComparison:
    """Compare with the truth, T_world_rig. Raise OmnidError where fewer than two poses have the same time."""
    T_rig_base = se3.inverse(T_base_rig)
    base = poses.trajectory
    estimate = Trajectory(base.stamps_ns, T_rig_base @ base.T @ T_base_rig)
    metrics = evaluate(estimate, truth, TOLERANCE_S)
    of_estimate, of_truth = _associated(estimate.stamps_ns, truth.stamps_ns)
    T_true = estimate.T[of_estimate[0]] @ se3.inverse(truth.T[of_truth[0]]) @ truth.T[of_truth]
    T_estimate = estimate.T[of_estimate]
    position_m, heading_rad, trace = Downsampled(), Downsampled(), path_trace()
    errors_m = np.linalg.norm(T_estimate[:, :3, 3] - T_true[:, :3, 3], axis=1)
    errors_rad = se3.yaw(se3.inverse(T_true) @ T_estimate)
    base_xy = (T_base_rig @ T_true @ T_rig_base)[:, :2, 3]
    rows = zip(estimate.stamps_ns[of_estimate], errors_m, errors_rad, base_xy, strict=True)
    for stamp_ns, error_m, error_rad, (x_m, y_m) in rows:
        t_s = poses.seconds(int(stamp_ns))
        position_m.add(t_s, float(error_m))
        heading_rad.add(t_s, float(error_rad))
        trace.add(Corner(float(x_m), float(y_m), t_s, 0))
    return TruthComparison(metrics, [(c.x_m, c.y_m) for c in trace.with_end()], position_m, heading_rad)


def _associated(stamps_ns: NDArray[np.int64], true_ns: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return indices of the estimates and of the truths nearest to them, within the tolerance."""
    after = np.clip(np.searchsorted(true_ns, stamps_ns), 1, len(true_ns) - 1)
    nearest = np.where(stamps_ns - true_ns[after - 1] <= true_ns[after] - stamps_ns, after - 1, after)
    near = np.flatnonzero(np.abs(stamps_ns - true_ns[nearest]) <= TOLERANCE_S * 1e9)
    return near, nearest[near]
