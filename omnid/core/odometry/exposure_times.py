"""Views at one instant from exposures at several: cameras that are not synchronised, and rolling shutters.

A pixel that is exposed tau after the pair's stamp shows a point where it is seen from T_odom_rect exp(V tau), with the
velocity V of the rectified frame. The difference between that and the view at the stamp is added to what was measured,
so that all else works with views of one instant. Its error is that of V, which is passed on as covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import at_scale
from omnid.core.stereo.semiglobal import ColumnShift
from omnid.core.stereo.triangulation import motion_jacobian, triangulate, view
from omnid.core.types.pixel_times import PixelTimes
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

# Rounds of triangulation and correction, few because each reduces the error by the ratio of motion to distance.
ROUNDS = 3
# Standard deviation, m/s and rad/s, below which a velocity is known well enough to check a rig: in 15 ms between two
# exposures that is an error of 3 mm and 0.2 degrees of the motion.
KNOWN_SIGMA = 0.2
# At scale 1: spacing of the points, and two disparities, at which the shift of columns is computed exactly. It follows
# azimuth and row smoothly, so that interpolation over 16 px, 5 degrees of a panorama of 1300 columns, loses little.
GRID_PX, DISPARITIES_PX = 16, (8.0, 40.0)


@dataclass(frozen=True, slots=True)
class RigVelocity:
    """Velocity [m/s; rad/s] of the rectified frame in its own axes, with its covariance (6, 6)."""

    twist: Array  # (6,)
    covariance: Array


# Velocity of synchronised frames: it needs no components, because no view depends on it.
NO_VELOCITY = RigVelocity(np.zeros(0), np.zeros((0, 0)))


@dataclass(frozen=True, slots=True)
class ViewShift:
    """What is added to the views of N points when they were exposed, for their views at the stamp."""

    px: Array  # (N, 4): lower column and row, upper row and column
    by_motion: Array  # (N, 4, K) its derivatives by the velocity
    motion: RigVelocity

    @property
    def noise(self) -> Array:
        """Covariance (N, 3, 3) [px^2] of corrected views by the uncertainty of the velocity."""
        J = self.by_motion[:, :3]
        return np.asarray(J @ self.motion.covariance @ np.swapaxes(J, 1, 2))

    @property
    def spread_px(self) -> Array:
        """Two standard deviations (N,) of the upper column by the uncertainty of the velocity."""
        J = self.by_motion[:, 3]
        return np.asarray(2 * np.sqrt(np.einsum("ni,ij,nj->n", J, self.motion.covariance, J)))


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """Times of exposure of a frame and the motion during it."""

    times: PixelTimes
    motion: RigVelocity
    model: StereoModel

    @property
    def is_known(self) -> bool:
        """True if the motion is known well enough to check a rig by views that are corrected for it."""
        return bool((np.diag(self.motion.covariance) < KNOWN_SIGMA**2).all())

    def shift(self, points: Array) -> ViewShift:
        """Return the shifts of points (N, 3) [m] in the rectified frame at the stamp."""
        if self.times.is_synchronised:
            count, unknowns = len(points), len(self.motion.twist)
            return ViewShift(np.zeros((count, 4)), np.zeros((count, 4, unknowns)), self.motion)
        cylinder, baseline_m = self.model.cylinder, self.model.baseline_m
        seen = view(points, cylinder, baseline_m)
        lower_s, upper_s = self.times.lower(seen[:, :2]), self.times.upper(seen[:, [0, 2]])
        in_lower, in_upper = (view(self._later(points, s), cylinder, baseline_m) for s in (lower_s, upper_s))
        px = np.column_stack([seen[:, :2] - in_lower[:, :2], (seen - in_upper)[:, [2, 0]]])
        px[:, [0, 3]] = cylinder.wrap(px[:, [0, 3]])
        J = motion_jacobian(points, cylinder, baseline_m)[:, [0, 1, 2, 0]]
        times_s = np.column_stack([lower_s, lower_s, upper_s, upper_s])
        return ViewShift(px, times_s[:, :, None] * J, self.motion)

    def _later(self, points: Array, times_s: Array) -> Array:
        """Return points (N, 3) in the rectified frame at times (N,) after the stamp: exp(-V tau) p to second order."""
        turn = self.motion.twist[3:]
        rate, tau = self.motion.twist[:3] + np.cross(turn, points), times_s[:, None]
        return np.asarray(points - tau * rate + tau**2 / 2 * np.cross(turn, rate))

    def upper_pixels(self, pixels: Array, disparity: Array) -> tuple[Array, Array]:
        """Return where the upper panorama shows pixels (N, 2) whose disparities (N,) at the stamp are known: (N, 2).

        Also the spread (N,) [px] of the columns, twice the standard deviation by the uncertainty of the velocity. NaN
        where the disparity is unknown.
        """
        known = np.flatnonzero(disparity > 0)
        views = np.column_stack([pixels, pixels[:, 1] + disparity])[known]
        shift = self.shift(triangulate(views, self.model.cylinder, self.model.baseline_m))
        # The lower pixel is known as seen: its view at the stamp differs by the shift.
        upper, spread_px = np.full((len(pixels), 2), np.nan), np.full(len(pixels), np.nan)
        upper[known] = views[:, [0, 2]] + shift.px[:, :2] - shift.px[:, [3, 2]]
        spread_px[known] = shift.spread_px
        return upper, spread_px

    def corrected(self, pixels: Array, rows: Array) -> tuple[Array, ViewShift]:
        """Return views (N, 3) at the stamp of pixels (N, 2) and upper rows (N,) as seen, NaN: without a point.

        Also their shifts. The shift depends on the depth, and the depth on the corrected view: so both are computed in
        turn.
        """
        views = seen = np.column_stack([pixels, rows])
        for _ in range(ROUNDS):
            points = triangulate(views, self.model.cylinder, self.model.baseline_m)
            known = np.isfinite(points).all(axis=1, keepdims=True)
            shift = self.shift(np.where(known, points, 1.0))
            views = np.where(known, seen + shift.px[:, :3], np.nan)
        return views, shift

    def column_shift(self, shape: tuple[int, int], pad_px: int) -> ColumnShift:
        """Return the shift of the upper columns of panoramas (H, W), which are padded by pad_px columns."""
        cylinder = self.model.cylinder
        grid_px, near = at_scale(GRID_PX, cylinder.scale), cylinder.scale * np.array(DISPARITIES_PX)
        rows, columns = (grid_px * (np.arange(-(-size // grid_px)) + 0.5) - 0.5 for size in shape)
        grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        corrected = [self.corrected(grid, grid[:, 1] + d) for d in near]
        shifts = [cylinder.wrap(views[:, 0] - shift.px[:, 3] - grid[:, 0]) for views, shift in corrected]
        slope = (shifts[1] - shifts[0]) / (near[1] - near[0])
        whole = len(columns) * grid_px, len(rows) * grid_px
        mode: Literal["wrap", "edge"] = "wrap" if cylinder.width == cylinder.period_px else "edge"
        fields = [
            cv2.resize(np.nan_to_num(field).astype(np.float32).reshape(len(rows), len(columns)), whole)
            for field in (shifts[0] - slope * near[0], slope)
        ]
        return ColumnShift(*(np.pad(f[: shape[0], : shape[1]], ((0, 0), (pad_px, pad_px)), mode=mode) for f in fields))
