"""Landmarks of a drive, tracked through keyframes in both panoramas, as observations for a calibration.

Each landmark is measured by its first keyframe's patch, warped to every later view in the lower and in the upper
panorama: an unwarped window between both panoramas errs by some hundredths of a pixel, always in the same direction,
which is some tenths of a per cent of the scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from calib.rig import Rig
from omnid.core.odometry.corners import APART_PX, clear_around, corners, nearby_disparity
from omnid.core.odometry.plane_patches import align, disparity_slopes, fitted_slopes, plane_templates
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.stereo.triangulation import triangulate, view
from omnid.core.types.panorama import PaddedPanorama
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
# Rows along the upper and the lower border in which a patch would reach beyond the panorama.
EDGE_ROWS: Final = 4
# Largest step of a patch: twice that of patches whose depth is known well, since the rig is not yet.
REACH_PX: Final = 2
# As the odometry's tracker. In the upper panorama the disparity predicts the place, so that one level is enough.
TRACK: Final = KltSettings()
TRACK_UPPER: Final = replace(TRACK, levels=1)


@dataclass(frozen=True, slots=True)
class View:
    """One instant of a drive: both panoramas, where both show the world, disparity of the lower one, and the pose."""

    lower: PaddedPanorama
    upper: PaddedPanorama
    visible: Flags  # (H, W)
    disparity: NDArray[np.float32]  # (H, W) px
    T_odom_rect: Array  # (4, 4)


@dataclass(frozen=True, slots=True)
class PanoramaObservations:
    """Pixels (M, 2) in the lower (camera 0) or upper (1) panorama of landmarks, seen from keyframes."""

    keyframe: Indices  # (M,)
    landmark: Indices  # (M,)
    camera: Indices  # (M,)
    pixels: Array  # (M, 2)
    points: Array  # (L, 3) m, in odom


class DriveLandmarks:
    """Tracks landmarks from keyframe to keyframe; keeps the images of the newest MAX_KEYFRAMES keyframes only."""

    def __init__(self, model: StereoModel, max_count: int = LANDMARKS) -> None:
        """max_count: landmarks in view of a keyframe."""
        self._model, self._max_count = model, max_count
        # The newest keyframes by their numbers, and the number of the last one.
        self._keyframes: dict[int, View] = {}
        self._number = -1
        # Landmarks (L): points [m] in odom; views [px], slopes of their surfaces and number of their first keyframe.
        self._points, self._views, self._slopes = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2))
        self._anchor = np.zeros(0, np.intp)
        # Landmarks that the newest keyframe shows, and their pixels in it.
        self._tracked, self._pixels = np.zeros(0, np.intp), np.zeros((0, 2))
        # Observations of each call: keyframe, landmark, camera, pixels.
        self._found: list[tuple[Indices, Indices, Indices, Array]] = []

    def add(self, view: View) -> None:
        """Take a keyframe: find the landmarks of the one before in it, and add new ones between them."""
        self._number += 1
        self._keyframes[self._number] = view
        self._keyframes.pop(self._number - MAX_KEYFRAMES - 1, None)
        if self._number:
            self._follow(view)
        self._start_landmarks(view)

    def observations(self) -> PanoramaObservations:
        """Return all observations of the landmarks that MIN_KEYFRAMES have seen, numbered from 0."""
        keyframe, landmark, camera = (np.concatenate([part[i] for part in self._found]) for i in range(3))
        count = np.bincount(landmark[camera == 0], minlength=len(self._points))
        kept = count[landmark] >= MIN_KEYFRAMES
        used, numbers = np.unique(landmark[kept], return_inverse=True)
        pixels = np.concatenate([part[3] for part in self._found])
        return PanoramaObservations(keyframe[kept], numbers, camera[kept], pixels[kept], self._points[used])

    def _follow(self, current: View) -> None:
        """Find the landmarks of the newest keyframe in the next one, in both of its panoramas."""
        # 1. Predict by the pose, and track in the lower panorama.
        index, before = self._tracked, self._pixels
        predicted = self._predicted(current, index)
        inside = (predicted[:, 1] > EDGE_ROWS) & (predicted[:, 1] < self._model.cylinder.height - 1 - EDGE_ROWS)
        inside &= self._model.cylinder.shows(predicted[:, 0])
        index, before, predicted = index[inside], before[inside], predicted[inside]
        there, found = track(self._keyframes[self._number - 1].lower, current.lower, before, predicted[:, :2], TRACK)
        index, there, predicted = index[found], there[found], predicted[found]
        # 2. Align the first keyframe's patches, so that the error does not grow from keyframe to keyframe.
        pixels, fits = self._aligned(current, index, there, upper=False)
        fits &= _is_set(current.visible, pixels)
        index, pixels, predicted = index[fits], pixels[fits], predicted[fits]
        self._observe(index, 0, pixels)
        # 3. The same in the upper panorama.
        guess = np.column_stack([pixels[:, 0], pixels[:, 1] + predicted[:, 2] - predicted[:, 1]])
        above, found = track(current.lower, current.upper, pixels, guess, TRACK_UPPER)
        in_upper, fits = self._aligned(current, index[found], above[found], upper=True)
        self._observe(index[found][fits], 1, in_upper[fits])
        # 4. Keep those whose first keyframe is still in memory at the next one.
        young = self._number - self._anchor[index] < MAX_KEYFRAMES
        self._tracked, self._pixels = index[young], pixels[young]

    def _start_landmarks(self, current: View) -> None:
        """Begin new landmarks in the gaps, where both panoramas show the same patch."""
        # 1. Corners in the gaps, with the disparity of the pixels around them.
        model = self._model
        free = clear_around(current.visible, self._pixels, APART_PX)
        pixels = corners(current.lower, free, self._max_count - len(self._pixels))
        disparity = nearby_disparity(current.disparity, pixels)
        pixels, disparity = pixels[np.isfinite(disparity)], disparity[np.isfinite(disparity)]
        # 2. Track them into the upper panorama.
        guess = pixels + np.column_stack([np.zeros(len(pixels)), disparity])
        above, found = track(current.lower, current.upper, pixels, guess, TRACK_UPPER)
        found &= above[:, 1] > pixels[:, 1] + 0.5
        pixels, above = pixels[found], above[found]
        # 3. Surfaces and points, by the rig as it is.
        views = np.column_stack([pixels, above[:, 1]])
        slopes = disparity_slopes(current.disparity, pixels, above[:, 1] - pixels[:, 1])
        slopes = fitted_slopes((current.lower, current.upper), pixels, above, slopes, model)
        points = triangulate(views, model.cylinder, model.baseline_m)
        # 4. Keep those whose patch fits in the upper panorama as well.
        first = len(self._points)
        self._points = np.concatenate([self._points, se3.apply(current.T_odom_rect, points)])
        self._views, self._slopes = np.concatenate([self._views, views]), np.concatenate([self._slopes, slopes])
        self._anchor = np.concatenate([self._anchor, np.full(len(points), self._number)])
        index = first + np.flatnonzero(np.isfinite(points).all(axis=1))
        in_upper, fits = self._aligned(current, index, above[index - first], upper=True)
        index = index[fits]
        self._observe(index, 0, pixels[index - first])
        self._observe(index, 1, in_upper[fits])
        self._tracked = np.concatenate([self._tracked, index])
        self._pixels = np.concatenate([self._pixels, pixels[index - first]])

    def _observe(self, index: Indices, camera: int, pixels: Array) -> None:
        """Note where the newest keyframe's lower (camera 0) or upper panorama shows landmarks."""
        count = len(index)
        self._found.append((np.full(count, self._number), index, np.full(count, camera), pixels))

    def _predicted(self, current: View, index: Indices) -> Array:
        """Return the views (M, 3) of landmarks as the keyframe's pose predicts them."""
        points = se3.apply(se3.inverse(current.T_odom_rect), self._points[index])
        return view(points, self._model.cylinder, self._model.baseline_m)

    def _aligned(self, current: View, index: Indices, near: Array, *, upper: bool) -> tuple[Array, Flags]:
        """Return pixels (M, 2) of landmarks near those given, by their first keyframes' patches, and which fit."""
        anchors = self._anchor[index]
        T_rect_odom = se3.inverse(current.T_odom_rect)
        known = {int(a): T_rect_odom @ self._keyframes[a].T_odom_rect for a in np.unique(anchors).tolist()}
        T_curr_ref = np.array([known[a] for a in anchors.tolist()]).reshape(-1, 4, 4)
        views, images = self._views[index], {a: self._keyframes[a].lower for a in known}
        surfaces = triangulate(views, self._model.cylinder, self._model.baseline_m), self._slopes[index]
        templates = plane_templates(images, anchors, views[:, :2], surfaces, T_curr_ref, self._model, near, upper=upper)
        aligned = align(templates, current.upper if upper else current.lower, near, REACH_PX)
        pixels = np.where(aligned.found[:, None], aligned.pixels, near)
        return np.column_stack([current.lower.own(pixels[:, 0]), pixels[:, 1]]), aligned.found


def _is_set(flags: Flags, pixels: Array) -> Flags:
    """Return flags (H, W) at the nearest of pixels (N, 2)."""
    column, row = np.rint(pixels).astype(int).T
    return np.asarray(flags[np.clip(row, 0, flags.shape[0] - 1), column % flags.shape[1]])


def image_pixels(observed: PanoramaObservations, rig: Rig, cylinder: Cylinder) -> Array:
    """Return the pixels (M, 2) in the cameras' own images, through the rig that made the panoramas; NaN outside."""
    rays = cylinder.rays(observed.pixels)
    pixels = np.full(observed.pixels.shape, np.nan)
    for side, mounted in enumerate((rig.lower, rig.upper)):
        R_cam_rect = mounted.T_cam_rig[:3, :3] @ rig.T_rect_rig[:3, :3].T
        at = observed.camera == side
        pixels[at] = mounted.camera.project(rays[at] @ R_cam_rect.T)
    return pixels
