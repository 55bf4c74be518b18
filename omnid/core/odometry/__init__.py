"""Visual odometry: the pose of the rig at each pair, with covariance and state.

Begin with `odometry.py`: `VisualOdometry.process` is the method in numbered steps. A residual is three calls away:
`PoseSearch.find` tries guesses of the pose (`pose_search.py`), `estimate` tracks the landmarks from one of them and
aligns the patches of their keyframes, and `gauss_newton` has the errors of their views (`pose_estimation.py`).

- Landmarks: `local_map.py` holds them relative to the keyframes that saw them, `new_landmarks.py` finds them in a pair.
- Pixels: `corners.py`, `tracking.py` (Lucas-Kanade), `plane_patches.py` with `patch_kernels.py` (patches of planes).
- Motion: `motion_filter.py` is the one error-state filter, which wheels and gyro enter by `motion_sensors.py`;
  `exposure_times.py` corrects views for the motion during the exposures.
- Doubt: `motion_hypotheses.py` keeps another motion where the world repeats, `image_breaks.py` and `line_times.py` find
  images that are torn, displaced or rolled, `motion_agreement.py` compares images, wheels and gyro over seconds,
  `static_mask.py` and `earlier_view.py` find what is fixed to the vehicle, `rig_error.py` has what the calibration
  leaves open.

`paper/` is the odometry as published in 2012. Arrays in, arrays out; `omnid/stages/front_end.py` calls it.
"""
