"""Cameras and rigs from corners of boards: start values, bundle adjustment, outliers, choice of the model."""
