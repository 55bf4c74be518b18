"""Observations of a drive: landmarks numbered again, and their pixels in both cameras."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.fit.drive.observations import DriveObservations, KeyframeMotion, project
from omnid.simulation.rendering.rigs import make_rig


def test_chosen_observations_have_their_landmarks_numbered_again() -> None:
    landmark = np.array([0, 3, 3, 7], np.intp)
    observed = DriveObservations(np.arange(4), landmark, np.array([0, 1, 0, 1]), np.arange(8.0).reshape(4, 2))
    kept, old = observed.only(np.array([False, True, True, True]))
    assert len(kept) == 3 and kept.landmark.tolist() == [0, 0, 1] and old.tolist() == [3, 7]
    assert kept.keyframe.tolist() == [1, 2, 3] and kept.pixels[0].tolist() == [2.0, 3.0]


def test_each_point_is_projected_in_its_camera() -> None:
    rig = make_rig(size=256, baseline_m=0.2)
    points = np.array([[2.0, 0.5, 0.1], [2.0, 0.5, 0.1], [np.nan, 0, 0]])
    found = project(rig, np.array([0, 1, 0]), points)
    for row, mounted in zip(found, (rig.lower, rig.upper), strict=False):
        assert np.allclose(row, mounted.camera.project(se3.apply(mounted.T_cam_rig, points[:1]))[0])
    assert not np.allclose(found[0], found[1]) and np.isnan(found[2]).all()


def test_images_of_one_instant_have_no_motion() -> None:
    still = KeyframeMotion.still(3)
    assert still.twist.shape == (3, 6) and not still.twist.any() and not still.upper_delay_s.any()
