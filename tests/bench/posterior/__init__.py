"""Obstacles by one posterior for each direction and range: an experiment that is to replace omnid/core/obstacles."""
