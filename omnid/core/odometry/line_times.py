"""Are the rows of the images read one after another? Residuals of the landmarks, pooled by image row over a second.

A row at the share s of a raw image (0: the first one, 1: the last one) that is read within the time c is exposed
c (s - 1/2) after its middle. Landmark x is then seen off by c f(s, x, V), f = -(s - 1/2) J(x) (v + w x x), by the
velocity V = [v; w] of the rig and the derivative J of a view by a point. In its keyframe k, which gives its position,
it was seen off in the same way, and its residual at a later pair is

    e = c (f(s, x, V) - J(x) R_k J(x_k)^-1 f(s_k, x_k, V_k)) + J(x) [-1 [x]x] d_k + noise,

d_k (6,) the error of the pose against that keyframe. The times c of both cameras, and a lag of the upper camera, whose
prior is that of a trigger's jitter, are one information filter; the d_k are eliminated (Schur complement). One c is as
likely as its generalised likelihood ratio, with the Bayesian information criterion. Of each pair one landmark in
CORRELATED is used, so that their errors are independent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.panorama import at_pixels
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.pose_estimation import CORRELATED, KERNEL_WIDTH, VIEW
from omnid.core.stereo.triangulation import motion_jacobian, view
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

LAG_S: Final = 0.003  # standard deviation of the time between the exposures of two cameras that are triggered together
LEAST_PX: Final = 0.5  # least displacement of a part of an image against the rest: less harms no pose
MEMORY_S: Final = 1.0  # time constant with which old evidence decays: vehicles change their motion more often
CAMERAS: Final = ("lower", "upper")
LAG: Final = 2  # the unknown behind the times of the lower and the upper camera
SETS: Final = ((0,), (1,), (0, 1))  # cameras whose images are wrong in one way


def camera_names(cameras: Sequence[int]) -> str:
    """Return cameras (0: lower, 1: upper) in words."""
    return " and the ".join(CAMERAS[camera] for camera in cameras) + (" cameras" if len(cameras) > 1 else " camera")


class RawImage:
    """Where the raw image of a camera shows the pixels of its panorama."""

    def __init__(self, u: NDArray[np.float32], v: NDArray[np.float32], size: tuple[int, int]) -> None:
        """u, v (H, W): raw column and row of each pixel, -1: none; size: columns and rows of the raw image."""
        self._maps, self.size = (u, v), size

    def at(self, pixels: Array) -> Array:
        """Return raw pixels (N, 2) of pixels (N, 2), NaN: none."""
        raw = np.column_stack([at_pixels(table, pixels) for table in self._maps]).astype(float)
        return np.where((raw >= 0).all(axis=1, keepdims=True), raw, np.nan)

    def derivatives(self, pixels: Array) -> Array:
        """Return the derivatives (N, 2, 2) of pixels (N, 2) by raw ones, NaN: raw pixels hardly change around them."""
        height, width = self._maps[0].shape
        column, row = np.rint(pixels).astype(np.intp).T
        column, row = np.clip(column, 2, width - 3), np.clip(row, 2, height - 3)
        across = np.column_stack([table[row, column + 2] - table[row, column - 2] for table in self._maps]) / 4.0
        down = np.column_stack([table[row + 2, column] - table[row - 2, column] for table in self._maps]) / 4.0
        of_raw = np.stack([across, down], axis=2).astype(float)
        of_raw[np.abs(np.linalg.det(of_raw)) <= 1e-3] = np.nan
        return np.linalg.inv(of_raw)


class ReadOut(NamedTuple):
    """Time in which the rows of images are read, last after first."""

    cameras: tuple[int, ...]  # 0: lower, 1: upper
    time_s: float
    gain: float  # logarithm of the likelihood ratio, less the cost of the parameter; above 0 it is likelier than none

    def words(self, raws: tuple[RawImage, RawImage]) -> str:
        """Return what was found of these images, and what to do."""
        is_stated = len(self.cameras) == len(raws)
        advice = "set line_time_s in its table [times]" if is_stated else "check the camera's shutter and its driver"
        line_us = 1e6 * self.time_s / raws[0].size[1]
        return (
            f"images of the {camera_names(self.cameras)} have rows that are read one after another: line time about "
            f"{line_us:+.0f} us beside that of the rig's file; {advice}, poses were degraded"
        )


class LineTimes:
    """Pools the residuals of the landmarks of a run."""

    def __init__(self, model: StereoModel, raws: tuple[RawImage, RawImage]) -> None:
        self._model, self._raws = model, raws
        self._velocities: dict[int, Array] = {}  # (6,) of the rig at each keyframe
        self._information = np.zeros((LAG + 2, LAG + 2))  # of [c, lag], bordered by that of the residuals
        self._views = 0.0  # that were pooled
        self._px_per_s = 0.0  # median motion of the landmarks in the last image

    def add(self, seq: int, seen: PoseEstimate, local_map: LocalMap, velocity: Array, dt_s: float) -> None:
        """Add the residuals of the inliers of a pair.

        seq: number of the pair. velocity (6,): of the rig in it [m/s; rad/s]. dt_s: since the pair before.
        """
        # 1. The velocities at the keyframes: the first one of a map has that of the step after it.
        known = {key: self._velocities.get(key, velocity) for key in local_map.keyframes}
        self._velocities = known | {seq: velocity}
        # 2. Residuals of the views, and their derivatives by [d_k, c, lag].
        cylinder, baseline_m = self._model.cylinder, self._model.baseline_m
        every = round(CORRELATED)
        chosen = np.arange(seq % every, len(seen.landmarks), every)
        table, rows = local_map.table, seen.landmarks[chosen]
        points, T_curr_anchor = local_map.seen(seen.T_odom_rect, rows)
        at_anchor, R = table.anchor_points[rows], T_curr_anchor[:, :3, :3]
        error = seen.views[chosen] - view(points, cylinder, baseline_m)
        error[:, 0] = cylinder.wrap(error[:, 0])
        of_motion = motion_jacobian(points, cylinder, baseline_m)
        J = of_motion[:, :, :3]
        anchors, group = np.unique(table.anchor[rows], return_inverse=True)
        velocities = np.array([known[key] for key in anchors.tolist()]).reshape(-1, 6)[group]
        J_anchor = motion_jacobian(at_anchor, cylinder, baseline_m)[:, :, :3]
        by_now, moved = self._shifts(points, J, velocity)
        by_anchor, _ = self._shifts(at_anchor, J_anchor, velocities)
        by_times = by_now - J @ R @ np.linalg.solve(J_anchor, by_anchor)
        # 3. Whitened, with the weights of the pose's kernel.
        S = self._model.sigma_px**2 * np.eye(3) + J @ R @ table.anchor_covariance[rows] @ np.swapaxes(J @ R, 1, 2)
        S[:, 2, 2] += seen.variance[chosen]
        rest = np.concatenate([-of_motion, by_times, error[:, :, None]], axis=2)
        usable = np.isfinite(rest).all(axis=(1, 2)) & np.isfinite(S).all(axis=(1, 2))
        if not usable.any():
            return
        rest = np.linalg.solve(np.linalg.cholesky(S[usable]), rest[usable])
        squared = (rest[:, :, -1] ** 2).sum(axis=1)
        weights = 1.0 / (1.0 + squared / KERNEL_WIDTH**2)
        # 4. The information of each keyframe, without its d_k.
        each, size = np.swapaxes(rest, 1, 2) * weights[:, None, None] @ rest, len(self._information)
        is_own = (group[usable] == np.arange(len(anchors))[:, None]).astype(float)
        total = (is_own @ each.reshape(len(each), -1)).reshape(-1, 6 + size, 6 + size)
        # A prior of a metre and a radian of each pose: a keyframe with one or two landmarks leaves next to nothing.
        of_d, across = total[:, :6, :6] + np.eye(6), total[:, :6, 6:]
        reduced = (total[:, 6:, 6:] - np.swapaxes(across, 1, 2) @ np.linalg.solve(of_d, across)).sum(axis=0)
        unit = max(1.0, float(squared.mean()) / VIEW)
        # 5. The sum over time. Where the view hardly moves, patches err as in the pair before: a sample is independent
        #    after a motion of one pixel.
        self._px_per_s = float(np.median(np.linalg.norm(moved[usable][:, :2], axis=1)))
        kept, new = math.exp(-dt_s / MEMORY_S), min(1.0, self._px_per_s * dt_s)
        self._information = kept * self._information + new * reduced / unit
        self._views = kept * self._views + new * len(squared)

    def likeliest(self) -> ReadOut | None:
        """Return the likeliest time of a read-out, None: it is likelier that there is none, or it moves no view."""
        information = self._information.copy()
        information[LAG, LAG] += LAG_S**-2
        information -= np.outer(information[:, LAG], information[LAG]) / information[LAG, LAG]
        cost, found = 0.5 * math.log(1.0 + VIEW * self._views) + math.log(len(SETS)), []
        for cameras in SETS:
            A, b = float(information[np.ix_(cameras, cameras)].sum()), float(information[list(cameras), -1].sum())
            if A > 0:
                found.append(ReadOut(cameras, b / A, b**2 / (2 * A) - cost))
        best = max(found, key=lambda each: each.gain, default=None)
        is_seen = best is not None and best.gain > 0 and abs(best.time_s) * self._px_per_s > LEAST_PX
        return best if is_seen else None

    def _shifts(self, points: Array, J: Array, velocity: Array) -> tuple[Array, Array]:
        """Return the derivatives (N, 3, 3) of the views of points (N, 3) by [c, lag], and their motion (N, 3) [px/s].

        velocity (6,) or (N, 6).
        """
        motion = -(J @ (velocity[..., :3] + np.cross(velocity[..., 3:], points))[:, :, None])[:, :, 0]
        seen, times = view(points, self._model.cylinder, self._model.baseline_m), np.zeros((len(points), 3, LAG + 1))
        for camera, of_view in enumerate((slice(0, 2), slice(2, 3))):
            raw = self._raws[camera].at(seen[:, [0, 1 + camera]])
            times[:, of_view, camera] = raw[:, 1:] / self._raws[camera].size[1] - 0.5
        times[:, 2, LAG] = 1.0
        return motion[:, :, None] * times, motion
