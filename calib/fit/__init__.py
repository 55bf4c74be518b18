"""Estimates of cameras and rigs from observations: boards, drives, and the drift of a rig; with covariances.

Begin with `least_squares.py`: the one robust Levenberg-Marquardt search with priors that all fits share. `boards/` fits
both cameras, the transform between them and the shape of the print to corners of boards. `rig_from_drive.py` is the
bundle adjustment of a drive without boards; `parameters.py` names its parameters, with units and priors. `rig_drift.py`
finds the rotation of one camera against the other by the columns of panoramas. `rig_uncertainty.py` predicts what the
covariance of a rig means for lengths and headings of drives. The package takes arrays; images and logs are read in
`omnid/calibration`.
"""
