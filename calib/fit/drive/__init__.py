"""Rigs from landmarks of a drive: parameters, prior, observations, bundle adjustment, choice of the terms."""
