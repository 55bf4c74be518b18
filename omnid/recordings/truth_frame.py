"""A truth of another body on the robot than the rig, such as a marker or an IMU: the pose of that body, fitted.

With the constant pose T_rig_body, and the unknown pose T_truth_odom of the estimate's world, the truth is

    T_truth_body = T_truth_odom T_odom_rig T_rig_body.

With A = R_truth_odom^T, positions from their means (bars), and the swing of the lever arm, this is robot-world and
hand-eye calibration (Shah 2013), solved by Gauss-Newton:

    A R_truth_body = R_odom_rig R_rig_body,    A bar(p_truth_body) = bar(p_odom_rig) + bar(R_odom_rig) t_rig_body.

The lever arm is fitted where it halves the error. What the path does not show, as its height by a drive in a plane,
stays 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib import se3
from omnid.formats.tum import Trajectory, parts
from omnid.recordings.evaluation import rotation_between

Array = NDArray[np.float64]
MAX_POSES: Final = 100  # Poses of a fit, evenly spread, for the 9 unknowns.
STEPS: Final = 10  # of Gauss-Newton
LEAST_SHOWN: Final = (
    0.01  # Smallest singular value, as a fraction of the largest, of what the path shows: half a degree.
)


@dataclass(frozen=True, slots=True)
class TruthFrame:
    """The pose of the body whose truth is given."""

    T_rig_body: Array  # (4, 4)
    freedom: int  # number of fitted unknowns of the body that the path determines
    unknown: str  # axes of the lever arm that the path does not show

    def rig_poses(self, truth: Trajectory) -> Trajectory:
        """Return the truth of the rig."""
        return Trajectory(truth.stamps_ns, truth.T @ se3.inverse(self.T_rig_body))

    def __str__(self) -> str:
        """Return the pose in one line."""
        R, (x, y, z) = parts(self.T_rig_body)
        w = np.rad2deg(se3.rotation_log(R))
        unknown = f" (the path does not show {self.unknown})" if self.unknown else ""
        angle_deg = float(np.linalg.norm(w))
        axis = " ".join(f"{part:.2f}" for part in w / max(angle_deg, 1.0))
        return (
            f"it is of another body than the rig, turned by {angle_deg:.1f} deg about ({axis}), at x {x:.3f} y {y:.3f} "
            f"z {z:.3f} m{unknown}"
        )


def find_truth_frame(estimate: Trajectory, truth: Trajectory) -> TruthFrame | None:
    """Return the pose of the body whose truth fits an estimate best; None where too few poses have the same times."""
    # 1. The estimate's poses that the truth covers, evenly chosen, and the truth interpolated there.
    covered = (estimate.stamps_ns >= truth.stamps_ns.min()) & (estimate.stamps_ns <= truth.stamps_ns.max())
    rows = np.flatnonzero(covered)
    if len(rows) <= 3 or len(truth.stamps_ns) <= 1:
        return None
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, MAX_POSES).astype(int))]
    stamps_ns = estimate.stamps_ns[rows]
    after = np.clip(np.searchsorted(truth.stamps_ns, stamps_ns, side="right"), 1, len(truth.T) - 1)
    before_ns, T_before = truth.stamps_ns[after - 1], truth.T[after - 1]
    part = (stamps_ns - before_ns) / (truth.stamps_ns[after] - before_ns)
    T_true = T_before @ se3.exp(se3.log(se3.inverse(T_before) @ truth.T[after]) * part[:, None])
    # 2. Without a lever arm, unless one leaves less than half of the error.
    turned, free = _fitted(estimate.T[rows], T_true, 6), _fitted(estimate.T[rows], T_true, 9)
    return (free if free[1] < turned[1] / 2 else turned)[0]


def _fitted(T_est: Array, T_true: Array, unknowns: int) -> tuple[TruthFrame, float]:
    """Return the body of the truth by poses (N, 4, 4) of the same times, and the error that is left.

    unknowns: 6 without a lever arm, 9 with it.
    """
    # 1. The start: the worlds by the positions, then the rotation of the body.
    (R, p), (true_R, true_p) = parts(T_est), parts(T_true)
    p, true_p, swing = p - p.mean(axis=0), true_p - true_p.mean(axis=0), R - R.mean(axis=0)
    A, _ = rotation_between(true_p, p)
    R_body, t_body = Rotation.from_matrix(np.swapaxes(R, 1, 2) @ A @ true_R).mean().as_matrix(), np.zeros(3)
    # 2. Gauss-Newton. A rotation counts as the movement of a point at the path's radius, which is the unit of length.
    radius = max(float(np.sqrt(np.square(true_p).sum(axis=1).mean())), np.finfo(float).tiny)
    J, eye, step, error = np.zeros((2, len(R), 3, 9)), np.eye(3), np.zeros(9), np.zeros(0)
    J[0, :, :, 6:], J[1, :, :, 3:6] = -swing, -eye
    for _ in range(STEPS):
        turned, moved = R @ R_body, true_p @ A.T / radius
        J[0, :, :, :3], J[1, :, :, :3] = np.cross(eye, moved[:, None]).swapaxes(1, 2), np.swapaxes(turned, 1, 2)
        off = moved - p / radius - swing @ t_body, se3.rotation_log(np.swapaxes(turned, 1, 2) @ A @ true_R)
        error = np.stack(off).ravel()
        step[:unknowns] = -np.linalg.pinv(J.reshape(-1, 9)[:, :unknowns], LEAST_SHOWN) @ error
        A, R_body, t_body = se3.rotation_exp(step[:3]) @ A, R_body @ se3.rotation_exp(step[3:6]), t_body + step[6:]
    # 3. What the path shows.
    _, shown, Vt = np.linalg.svd(J.reshape(-1, 9)[:, :unknowns], full_matrices=False)
    is_shown = shown >= LEAST_SHOWN * shown[0]
    hidden = np.abs(Vt[~is_shown, 6:]).max(axis=0, initial=0.0) > 0.5
    unknown = ", ".join(axis for axis, is_hidden in zip("xyz", hidden, strict=False) if is_hidden)
    frame = TruthFrame(se3.transform(R_body, radius * t_body), int(is_shown.sum()) - 3, unknown)
    return frame, float(np.linalg.norm(error))
