"""Calibration of two cameras by the corners of boards, as one maximum a posteriori estimate.

Begin with `rig_fit.py`: it takes the views of both cameras, rejects those that contradict the others, and returns the
cameras, the transform between them and the covariance. `start.py` finds the first camera models and poses of the board
from nothing but corners. `bundle.py` holds the parameters (cameras, transform, poses, shape of the print), their priors
and residuals: no term is selected, the priors shrink what the images do not show. It also holds the covariance, with
the error of the model as a smooth field over the image.
"""
