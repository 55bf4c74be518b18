"""Landmarks of a drive, tracked through keyframes in both panoramas, as observations for a calibration.

Each landmark is measured by its first keyframe's patch, warped to every later view in the lower and in the upper
panorama: an unwarped window between both panoramas errs by some hundredths of a pixel, always in the same direction,
which is some tenths of a per cent of the scale.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.fit.rig_from_drive import DriveObservations
from calib.panorama import Cylinder, at_pixels
from calib.rig import Rig
from omnid.core.odometry.corners import clear_around, corners, nearby_disparity
from omnid.core.odometry.local_map import Keyframe, LocalMap, NewLandmarks
from omnid.core.odometry.plane_patches import REACH_PX, disparity_slopes, fitted_slopes
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.types.panorama import Panoramas
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

# Landmarks in view of a keyframe, no more because the time of the adjustment grows with them, the sigmas fall with
# their root.
LANDMARKS: Final = 500
# Most keyframes that see one landmark, because from farther away its patch has another appearance, and images are kept
# so long.
MAX_KEYFRAMES: Final = 25
# Two keyframes and the landmark's own three coordinates leave almost nothing that the rig could contradict, so that
# there must be a third.
MIN_KEYFRAMES: Final = 3
# In the upper panorama the disparity predicts the place, so that one level is enough.
TRACK_UPPER: Final = KltSettings(levels=1)


class DriveLandmarks:
    """Tracks landmarks from keyframe to keyframe; keeps the images of the newest MAX_KEYFRAMES keyframes only."""

    def __init__(self, model: StereoModel) -> None:
        self._model = model
        # Landmarks that a keyframe does not show are not sought again.
        self._map = LocalMap(model, KltSettings(), MAX_KEYFRAMES, max_misses=1)
        self._number = -1  # of the last keyframe
        self._points = np.zeros((0, 3))  # (L, 3) m, in odom, by their ids
        # Observations of each call: keyframe, landmark, camera, pixels.
        self._found: list[tuple[Indices, Indices, Indices, Array]] = []

    def add(self, pair: Panoramas, disparity: NDArray[np.float32], T_odom_rect: Array) -> None:
        """Take a keyframe: find the landmarks of the one before in it, and add new ones between them.

        disparity (H, W) [px] of the lower panorama; T_odom_rect (4, 4): its pose.
        """
        self._number += 1
        if self._number:
            self._follow(pair, T_odom_rect)
        self._start_landmarks(pair, disparity, T_odom_rect)

    def observations(self) -> tuple[DriveObservations, Array]:
        """Return all observations, in the panoramas, of landmarks that MIN_KEYFRAMES have seen, numbered from 0.

        Also the landmarks (L, 3) [m] in odom.
        """
        keyframe, landmark, camera, pixels = map(np.concatenate, zip(*self._found, strict=True))
        count = np.bincount(landmark[camera == 0], minlength=len(self._points))
        found = DriveObservations(keyframe, landmark, camera, pixels)
        kept, used = found.only(count[landmark] >= MIN_KEYFRAMES)
        return kept, self._points[used]

    def _follow(self, current: Panoramas, T_odom_rect: Array) -> None:
        """Find the landmarks of the newest keyframe in the next one, in both of its panoramas."""
        # 1. Predict by the pose, track in the lower panorama, and align the first keyframe's patches, so that the error
        #    does not grow from keyframe to keyframe.
        tracks = self._map.track(current.lower, T_odom_rect)
        pixels, fits = self._aligned(current, T_odom_rect, tracks.landmarks, tracks.pixels, upper=False)
        fits &= at_pixels(current.visible, pixels)
        rows, pixels, predicted = tracks.landmarks[fits], pixels[fits], tracks.predicted[fits]
        self._observe(rows, 0, pixels)
        # 2. The same in the upper panorama.
        guess = np.column_stack([pixels[:, 0], pixels[:, 1] + predicted[:, 2] - predicted[:, 1]])
        above, found = track(current.lower, current.upper, pixels, guess, TRACK_UPPER)
        in_upper, fits = self._aligned(current, T_odom_rect, rows[found], above[found], upper=True)
        self._observe(rows[found][fits], 1, in_upper[fits])
        self._map.update_tracked(current.lower, rows, pixels)

    def _start_landmarks(self, current: Panoramas, disparity: NDArray[np.float32], T_odom_rect: Array) -> None:
        """Begin new landmarks in the gaps, where both panoramas show the same patch."""
        # 1. Corners in the gaps, with the disparity of the pixels around them.
        known_pixels, pair = self._map.table.pixels, (current.lower, current.upper)
        free = clear_around(current.visible, known_pixels)
        pixels = corners(current.lower, free, LANDMARKS - len(known_pixels))
        nearby = nearby_disparity(disparity, pixels)
        pixels, nearby = pixels[np.isfinite(nearby)], nearby[np.isfinite(nearby)]
        # 2. Track them into the upper panorama.
        above, found = track(*pair, pixels, pixels + np.outer(nearby, [0.0, 1.0]), TRACK_UPPER)
        found &= above[:, 1] > pixels[:, 1] + 0.5
        pixels, above = pixels[found], above[found]
        # 3. Surfaces and points, by the rig as it is.
        slopes = disparity_slopes(disparity, pixels, above[:, 1] - pixels[:, 1])
        slopes = fitted_slopes(pair, pixels, above, slopes, self._model)
        keyframe = Keyframe(self._number, current.lower, T_odom_rect, np.zeros((6, 6)))
        views, noise = np.column_stack([pixels, above[:, 1]]), np.zeros((len(pixels), 3, 3))
        located = NewLandmarks(pixels, views, slopes, noise)
        known = self._map.add_keyframe(keyframe, located)
        rows = np.flatnonzero(self._map.table.anchor == self._number)
        self._points = np.concatenate([self._points, self._map.table.points[rows]])
        # 4. Keep those whose patch fits in the upper panorama as well.
        in_upper, fits = self._aligned(current, T_odom_rect, rows, above[known], upper=True)
        self._observe(rows[fits], 0, pixels[known][fits])
        self._observe(rows[fits], 1, in_upper[fits])
        self._map.remove(rows[~fits])

    def _observe(self, rows: Indices, camera: int, pixels: Array) -> None:
        """Note where the newest keyframe's lower (camera 0) or upper panorama shows landmarks (rows of the map)."""
        count = len(rows)
        self._found.append((np.full(count, self._number), self._map.table.id[rows], np.full(count, camera), pixels))

    def _aligned(
        self, current: Panoramas, T_odom_rect: Array, rows: Indices, near: Array, *, upper: bool
    ) -> tuple[Array, Flags]:
        """Return pixels (M, 2) of landmarks near those given, by their first keyframes' patches, and which fit."""
        image = current.upper if upper else current.lower
        # A patch may move twice as far as one whose depth is known well, since the rig is not yet.
        aligned = self._map.align(image, T_odom_rect, rows, near, 2 * REACH_PX, upper=upper)
        pixels = np.where(aligned.found[:, None], aligned.pixels, near)
        return np.column_stack([current.lower.own(pixels[:, 0]), pixels[:, 1]]), aligned.found


def in_images(seen: DriveObservations, points: Array, rig: Rig, cylinder: Cylinder) -> tuple[DriveObservations, Array]:
    """Return observations in panoramas as those in the cameras' images, and the landmarks (L, 3) that are left.

    rig: the one that made the panoramas. What has no image or no finite point is left out.
    """
    rays = cylinder.rays(seen.pixels)
    pixels = np.full(seen.pixels.shape, np.nan)
    for side, mounted in enumerate((rig.lower, rig.upper)):
        R_cam_rect = mounted.T_cam_rig[:3, :3] @ rig.T_rect_rig[:3, :3].T
        at = seen.camera == side
        pixels[at] = mounted.camera.project(rays[at] @ R_cam_rect.T)
    known = np.isfinite(pixels).all(axis=1) & np.isfinite(points[seen.landmark]).all(axis=1)
    kept, used = replace(seen, pixels=pixels).only(np.asarray(known))
    return kept, points[used]
