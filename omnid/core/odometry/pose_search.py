"""From a guess to a pose: tracks, RANSAC, Gauss-Newton, aligned patches; and where to get guesses from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.corners import rows_in_upper
from omnid.core.odometry.landmarks import LocalMap, Tracks
from omnid.core.odometry.pose_estimate import PoseEstimate
from omnid.core.odometry.pose_estimation import GaussNewtonResult, StereoModel, gauss_newton, ransac
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings, PaddedPanorama
from omnid.core.odometry.yaw_search import correlation_peaks, steps

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

LEAST = 6  # landmarks, below which six unknowns are no estimate
OUTLIER = 16.0  # squared deviations
SAMPLE = 150  # landmarks that decide between turns
ENOUGH = 0.5  # share of them, tracked, that ends the search
COARSE_SIGMA_PX = 0.3  # of a track before its patch is bent to the new viewpoint
ALIKE = 4.0  # landmarks that count as one: texture, depth and keyframe make neighbours err alike


class PoseSearch:
    """Finds the pose of a sight in the local map."""

    def __init__(self, local_map: LocalMap, model: StereoModel, klt: KltSettings) -> None:
        self._map, self._model = local_map, model
        self._coarse_model = replace(model, sigma_px=COARSE_SIGMA_PX)
        self._stereo_klt = replace(klt, levels=1)

    def from_guess(self, frame: StereoFrame, guess: Array) -> PoseEstimate | None:
        """The pose near a guess T_odom_rect; None where hardly any landmark agrees."""
        tracks = self._map.track(frame.lower, guess)
        if len(tracks.index) < LEAST:
            return None
        views = self._views(frame, tracks)
        T_guess_odom = se3.inverse(guess)
        in_guess = se3.apply(T_guess_odom, self._map.points[tracks.index])
        T_curr_guess, agree = ransac(in_guess, views, self._model, np.random.default_rng(frame.seq))
        inliers = tracks.index[agree], views[agree]
        coarse, kept = self._solve(inliers, T_curr_guess @ T_guess_odom, self._coarse_model)
        if coarse is None:
            return None
        disparity = np.full(len(self._map), np.nan)
        disparity[inliers[0][kept]] = (inliers[1][:, 2] - inliers[1][:, 1])[kept]
        fine = self._polish(frame, coarse.T, disparity)
        if fine is None:
            return None
        # Both must speak for the pose: the tracks from the last sight, and the patches of the keyframes.
        agreeing_both = min(int(kept.sum()), len(fine.landmarks))
        others = np.ones(len(self._map), bool)
        others[fine.landmarks] = False
        return replace(fine, visible=tracks.visible, tracked=len(tracks.index), inliers=agreeing_both,
                       rejected=tracks.pixels[others[tracks.index]])

    def best_turn(
        self, frame: StereoFrame, previous: PaddedPanorama, guess: tuple[Array, Array], usable: Flags
    ) -> Array:
        """The guess T_odom_rect with the most forward-backward tracks among turns of the previous pose.

        guess: the previous pose, and the expected one, whose position is kept. The turns are the peaks of the circular
        correlation, and where none of these will do the paper's steps (Dang et al. 2012, section IV.F).
        """
        T_odom_previous, expected = guess
        best, most = expected, -1.0
        for turn in correlation_peaks(previous.panorama, frame.lower.panorama, usable) + steps():
            turned = T_odom_previous @ se3.exp([0, 0, 0, 0, 0, turn])
            turned[:3, 3] = expected[:3, 3]
            tracks = self._map.track(frame.lower, turned, most=SAMPLE)
            share = len(tracks.index) / max(1, tracks.visible)
            if share > most:
                best, most = turned, share
            if most > ENOUGH:
                break
        return best

    def _views(self, frame: StereoFrame, tracks: Tracks) -> Array:
        """Views (M, 3): tracked pixels and, where the upper panorama confirms them, the rows there."""
        rows = tracks.pixels[:, 1] + tracks.predicted[:, 2] - tracks.predicted[:, 1]
        found = rows_in_upper((frame.lower, frame.upper), tracks.pixels, rows, self._stereo_klt)
        return np.column_stack([tracks.pixels, found])

    def _solve(self, inliers: tuple[Indices, Array], T_curr_odom: Array, model: StereoModel
               ) -> tuple[GaussNewtonResult | None, Flags]:
        """Gauss-Newton on landmarks and their views, once more on those (flags) that fit; None where too few do."""
        landmarks, views = inliers
        kept = np.ones(len(landmarks), bool)
        estimate = None
        if len(landmarks) < LEAST:
            return None, kept
        for _ in range(2):
            chosen = landmarks[kept]
            estimate = gauss_newton(self._map.points[chosen], self._map.covariance[chosen], views[kept], T_curr_odom,
                                    model)
            T_curr_odom = estimate.T
            squared = np.full(len(landmarks), np.inf)
            squared[kept] = estimate.squared
            kept = squared < OUTLIER
            if kept.sum() < LEAST:
                return None, kept
        return estimate, kept

    def _polish(self, frame: StereoFrame, T_curr_odom: Array, disparity: Array) -> PoseEstimate | None:
        """The pose again, from the patches of all landmarks in view, aligned as the coarse pose predicts them.

        disparity (N,): of the landmarks that were tracked, NaN else; measured between images of one instant, it
        goes along with the lower row.
        """
        landmarks, _ = self._map.visible(se3.inverse(T_curr_odom))
        pixels, fitted = self._map.align(frame.lower, se3.inverse(T_curr_odom), landmarks)
        landmarks, pixels = landmarks[fitted], pixels[fitted]
        views = np.column_stack([pixels, pixels[:, 1] + disparity[landmarks]])
        estimate, kept = self._solve((landmarks, views), T_curr_odom, self._model)
        if estimate is None:
            return None
        scale = ALIKE * max(1.0, float(estimate.squared.mean()) / 3)
        return PoseEstimate(
            se3.inverse(estimate.T), scale * estimate.covariance, 0, 0, 0, landmarks[kept], views[kept, :2]
        )
