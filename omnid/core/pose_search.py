"""From a guess to a pose: tracks, RANSAC, Gauss-Newton; and where to get guesses from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.features import rows_in_upper
from omnid.core.fit import Fit
from omnid.core.klt import Klt, Wrapped
from omnid.core.local_map import LocalMap, Tracks
from omnid.core.motion import StereoModel, gauss_newton, ransac
from omnid.core.sight import Sight
from omnid.core.yaw import correlation_peaks, steps

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

LEAST = 6  # landmarks, below which six unknowns are no estimate
OUTLIER = 16.0  # squared deviations
SAMPLE = 150  # landmarks that decide between turns


class PoseSearch:
    """Finds the pose of a sight in the local map."""

    def __init__(self, local_map: LocalMap, model: StereoModel, klt: Klt) -> None:
        self._map, self._model = local_map, model
        self._stereo_klt = replace(klt, levels=1)

    def from_guess(self, sight: Sight, guess: Array) -> Fit | None:
        """The pose near a guess T_odom_rect; None where hardly any landmark agrees."""
        tracks = self._map.track(sight.lower, guess)
        if len(tracks.index) < LEAST:
            return None
        views = self._views(sight, tracks)
        T_guess_odom = se3.inverse(guess)
        in_guess = se3.apply(T_guess_odom, self._map.points[tracks.index])
        T_curr_guess, agree = ransac(in_guess, views, self._model, np.random.default_rng(sight.seq))
        T_curr_odom, agree = self._refine(tracks, views, agree, T_curr_guess @ T_guess_odom)
        return self._polish(sight, tracks, views, agree, T_curr_odom)

    def best_turn(self, sight: Sight, previous: Wrapped, T_odom_previous: Array, usable: Flags) -> Array:
        """The pose guess with the most forward-backward tracks among turns of the previous pose.

        The turns are the peaks of the circular correlation and the paper's steps (Dang et al. 2012, section IV.F).
        """
        turns = correlation_peaks(previous.panorama, sight.lower.panorama, usable) + steps()
        guesses = [T_odom_previous @ se3.exp([0, 0, 0, 0, 0, turn]) for turn in turns]
        found = [len(self._map.track(sight.lower, guess, sample=SAMPLE).index) for guess in guesses]
        return guesses[int(np.argmax(found))]

    def _views(self, sight: Sight, tracks: Tracks) -> Array:
        """Views (M, 3): tracked pixels and, where the upper panorama confirms them, the rows there."""
        rows = tracks.pixels[:, 1] + tracks.predicted[:, 2] - tracks.predicted[:, 1]
        found = rows_in_upper((sight.lower, sight.upper), tracks.pixels, rows, self._stereo_klt)
        return np.column_stack([tracks.pixels, found])

    def _polish(self, sight: Sight, tracks: Tracks, views: Array, agree: Flags, T_curr_odom: Array) -> Fit | None:
        """The pose from the same landmarks once their patches, warped as the coarse pose predicts, are aligned."""
        if agree.sum() < LEAST: return None
        index=tracks.index[agree]
        pixels, fitted = self._map.align(sight.lower, se3.inverse(T_curr_odom), index)
        v=views[agree].copy()
        # the upper row goes along: the disparity was measured between two panoramas of one instant
        v[:,2] += pixels[:,1]-v[:,1]
        v[:,:2] = pixels
        index, v = index[fitted], v[fitted]
        for _ in range(2):
            if len(index) < LEAST: return None
            estimate = gauss_newton(self._map.points[index], self._map.covariance[index], v, T_curr_odom, self._model)
            T_curr_odom = estimate.T
            good = estimate.squared < OUTLIER
            index, v, squared = index[good], v[good], estimate.squared[good]
        scale = max(1.0, float(squared.mean()) / 3)
        self.debug=squared.mean()/3
        return Fit(se3.inverse(T_curr_odom), scale * estimate.covariance, tracks.visible, len(tracks.index),
                   len(index), index, v[:, :2])

    def _refine(self, tracks: Tracks, views: Array, agree: Flags, T_curr_odom: Array):
        for _ in range(2):
            if agree.sum() < LEAST:
                return T_curr_odom, agree
            index = tracks.index[agree]
            estimate = gauss_newton(self._map.points[index], self._map.covariance[index], views[agree], T_curr_odom,
                                    self._model)
            T_curr_odom = estimate.T
            agree[agree] = estimate.squared < OUTLIER
        return T_curr_odom, agree
