"""Visual odometry: the pose of the rig at each pair, with covariance and state.

Begin with `odometry.py`: `VisualOdometry.process` is the method in numbered steps. Landmarks live in `local_map.py`,
relative to the keyframes that saw them; `pose_search.py` predicts, tracks and refines; `pose_estimation.py` is RANSAC
and Gauss-Newton on bearings of both cameras. `motion_filter.py` is the one error-state filter that wheels and gyro
enter; `motion_hypotheses.py` keeps another motion where the world repeats; `image_breaks.py` finds images that are
torn or displaced. `paper/` is the odometry as published in 2012. Arrays in, arrays out; `omnid/stages/front_end.py`
calls it.
"""
