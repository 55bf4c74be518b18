"""Recorded runs: reading them, comparing two of them, evaluating a trajectory against the truth."""
