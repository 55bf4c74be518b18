"""The odometry of Dang, Ly, Nguyen (2012), section IV, as published; selected by `--method paper`.

`paper_odometry.py` has the steps frame to frame: features, KLT with steps of 18 degrees, RANSAC and least squares on
3-D points (eq. 6 to 9), and the Kalman filter (eq. 10 to 12); `registration.py` aligns the point sets. It is kept so
that the paper's experiments can be made again (`python -m tests.bench.paper`), and as a measure for the default method.
"""
