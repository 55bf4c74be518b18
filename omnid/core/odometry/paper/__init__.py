"""The odometry of Dang, Ly, Nguyen (2012), section IV, as published: `omnid replay --method paper`.

`paper_odometry.py` has the steps of figure 5 with the numbers of their equations; corners, tracking and RANSAC are
those of the package above. `python -m tests.bench.paper` makes the experiments of the paper again.
"""
