"""Motion of the rig during the exposures of frames, and the steps of the odometry that depend on it.

The velocity is predicted before a frame is estimated, and known better afterwards. Frames whose pixels are all exposed
at the stamp take the same steps, with an exposure that corrects nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import at_scale
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.exposure_times import NO_VELOCITY, UNKNOWN_VELOCITY, Exposure
from omnid.core.odometry.frame_to_map import CoarsePose, FrameToMap
from omnid.core.odometry.keyframes import KeyframeRequest, Keyframes
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.motion_model import MotionModel
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.stereo.semiglobal import ColumnShift
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# Spacing, at scale 1, of the points at which the correction is computed exactly. The fields follow the azimuth and the
# row smoothly, so that interpolation over 16 px, 5 degrees of a panorama of 1300 columns, loses little.
GRID_PX = 16
DISPARITIES_PX = (8.0, 40.0)  # At scale 1: disparities at which the correction is exact.


class CorrectedPixels(NamedTuple):
    """Views of N pixels at the stamp, and the variance of their disparities by the uncertainty of the velocity."""

    views: Array  # (N, 3) px: column, lower row, upper row
    variance: Array  # (N,) px^2


@dataclass(frozen=True, slots=True)
class DenseCorrection:
    """Fields (H, W, 2) of a and b of a + b disparity, for disparities as seen between the exposures, px."""

    view: tuple[Floats, Floats, Floats]  # corrections from the pixel and its upper row as seen to the view at the stamp
    column: Floats  # correction from the lower column to that of the upper panorama
    sigma: Floats  # standard deviation of the corrected disparity by the uncertainty of the velocity
    wraps: bool = True  # the panoramas show a full turn

    @staticmethod
    def of(exposure: Exposure, shape: tuple[int, int]) -> DenseCorrection:
        """Return the correction of panoramas (H, W)."""
        scale = exposure.model.cylinder.scale
        grid_px, near = at_scale(GRID_PX, scale), [scale * disparity for disparity in DISPARITIES_PX]
        rows, columns = (grid_px * (np.arange(-(-size // grid_px)) + 0.5) - 0.5 for size in shape)
        grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        found = [_exact(exposure, grid, disparity) for disparity in near]
        slope = (found[1] - found[0]) / (near[1] - near[0])
        both = np.stack([found[0] - slope * near[0], slope], axis=-1)  # (N, 5, 2)
        coarse = np.nan_to_num(both).astype(np.float32).reshape(len(rows), len(columns), 5, 2)
        whole = (len(columns) * grid_px, len(rows) * grid_px)
        fields = [_resized(coarse[:, :, k], whole)[: shape[0], : shape[1]] for k in range(5)]
        return DenseCorrection(
            (fields[0], fields[1], fields[2]),
            fields[3],
            fields[4],
            exposure.model.cylinder.width == exposure.model.cylinder.turn_px,
        )

    def column_shift(self, pad_px: int) -> ColumnShift:
        """Return the shift of the upper column for padded panoramas."""
        mode: Literal["wrap", "edge"] = "wrap" if self.wraps else "edge"
        padded = np.pad(self.column, ((0, 0), (pad_px, pad_px), (0, 0)), mode=mode)
        return ColumnShift(np.ascontiguousarray(padded[:, :, 0]), np.ascontiguousarray(padded[:, :, 1]))

    def corrected(self, columns: Indices, rows: Indices, disparity: Floats) -> CorrectedPixels:
        """Return the views at the stamp of pixels (N,) with disparities (N,) [px] as seen."""
        shifts = np.column_stack([_at(field, columns, rows, disparity) for field in self.view])
        views = np.column_stack([columns, rows, rows + disparity]).astype(float) + shifts
        return CorrectedPixels(views, _at(self.sigma, columns, rows, disparity) ** 2)


def _exact(exposure: Exposure, pixels: Array, disparity: float) -> Array:
    """Return the shifts (N, 3) of the views, of the upper column, and the sigma of the disparity: (N, 5)."""
    rows = pixels[:, 1] + disparity
    views, noise = exposure.corrected(pixels, rows)
    columns, _ = exposure.upper_columns(pixels, rows)
    shifts = views - np.column_stack([pixels, rows])
    variance = noise[:, 1, 1] + noise[:, 2, 2] - 2 * noise[:, 1, 2]
    column_shift = exposure.model.cylinder.wrap(columns - pixels[:, 0])
    return np.column_stack([shifts, column_shift, np.sqrt(np.maximum(variance, 0.0))])


def _resized(field: Floats, size: tuple[int, int]) -> Floats:
    return np.asarray(cv2.resize(np.ascontiguousarray(field), size), np.float32)


def _at(field: Floats, columns: Indices, rows: Indices, disparity: Floats) -> Array:
    a, b = field[rows, columns].T
    return np.asarray(a + b * disparity, float)


Flags = NDArray[np.bool_]

# The depths of the first frame are measured as if the rig were at rest, so the motion is wrong by a few per cent of
# what happens between two exposures, and two are enough because each round of starting the map again reduces the error
# by this ratio.
START_ROUNDS = 2


class RequestAtPose(Protocol):
    """Makes the request of a keyframe at the last accepted pose."""

    def __call__(self, frame: StereoFrame, usable: Flags, exposure: Exposure) -> KeyframeRequest:
        """Return the request; usable (H, W): pixels in which landmarks may lie."""


class FrameExposures:
    """Exposures of frames by the velocity of a motion model."""

    def __init__(
        self,
        motion: MotionModel,
        model: StereoModel,
        *,
        max_gap_s: float,
        local_map: LocalMap,
        keyframes: Keyframes,
        frame_to_map: FrameToMap,
    ) -> None:
        """max_gap_s: a longer step shows no velocity."""
        self._motion, self._model, self._max_gap_s = motion, model, max_gap_s
        self._map, self._keyframes, self._frame_to_map = local_map, keyframes, frame_to_map
        self._first: StereoFrame | None = None  # started the map before its velocity was known

    def predicted(self, frame: StereoFrame, dt_s: float) -> Exposure:
        """Return the exposure of the frame to which a step of dt_s was predicted."""
        velocity = NO_VELOCITY if frame.times.is_at_once else self._motion.at_exposure(dt_s)
        return Exposure.of(frame.times, velocity, self._model)

    def now(self, frame: StereoFrame) -> Exposure:
        """Return the exposure of a frame by the velocity that the filter has now."""
        velocity = NO_VELOCITY if frame.times.is_at_once else self._motion.now()
        return Exposure.of(frame.times, velocity, self._model)

    def refine(
        self, frame: StereoFrame, coarse: CoarsePose, exposure: Exposure, T_odom_prev: Array, dt_s: float
    ) -> PoseEstimate | None:
        """Refine a pose; where the velocity matters, once more with that which the pose implies.

        T_odom_prev (4, 4): pose dt_s [s] before. A sudden motion implies no velocity.
        """
        refined = self._frame_to_map.refine(frame, coarse, exposure)
        if refined is None or frame.times.is_at_once or not 0 < dt_s <= self._max_gap_s:
            return refined
        T_prev_curr = se3.inverse(T_odom_prev) @ refined.T_odom_rect
        is_sudden = self._motion.is_sudden(T_prev_curr, dt_s)
        velocity = UNKNOWN_VELOCITY if is_sudden else self._motion.after(T_prev_curr, refined.covariance, dt_s)
        settled = Exposure.of(frame.times, velocity, self._model)
        coarse = self._frame_to_map.estimate_again(frame, coarse, refined.T_odom_rect, settled)
        return self._frame_to_map.refine(frame, coarse, settled)

    def map_started(self, frame: StereoFrame) -> None:
        """Note that a frame started the map; where its velocity matters, the map starts again with the next pose."""
        self._first = None if frame.times.is_at_once else frame

    def forget_first(self) -> None:
        """Keep the map as it is: after a refused pose the next one shows no velocity at the first frame."""
        self._first = None

    def start_again(
        self,
        frame: StereoFrame,
        usable: Flags,
        estimate: PoseEstimate,
        dt_s: float,
        *,
        request: RequestAtPose,
        tracked: int,
    ) -> PoseEstimate:
        """Start the map again at its first frame, if its velocity was not known; return the pose of the second frame.

        estimate: of the second frame, dt_s [s] after the last accepted pose. tracked: landmarks tracked at most.
        """
        first, self._first = self._first, None
        if first is None or not 0 < dt_s <= self._max_gap_s:
            return estimate
        for _ in range(START_ROUNDS):
            # 1. The second frame shows the velocity at both frames.
            start = request(first, usable & first.usable, self.now(first))
            T_prev_curr = se3.inverse(start.T_odom_rect) @ estimate.T_odom_rect
            velocity = self._motion.after(T_prev_curr, estimate.covariance, dt_s)
            # 2. Start the map with it.
            self._map.clear()
            self._keyframes.add(replace(start, exposure=Exposure.of(first.times, velocity, self._model)))
            # 3. Estimate the second frame again.
            exposure = Exposure.of(frame.times, velocity, self._model)
            tracks = self._map.track(frame.lower, estimate.T_odom_rect, tracked, turn=frame.seq)
            coarse = self._frame_to_map.estimate(frame, tracks, estimate.T_odom_rect, exposure)
            again = self.refine(frame, coarse, exposure, start.T_odom_rect, dt_s) if coarse else None
            estimate = again if again is not None else estimate.without_landmarks
        return estimate
