"""Recorded runs: reading them, and evaluating a trajectory against the truth."""
