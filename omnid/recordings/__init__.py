"""Recorded runs: read, compared with each other, evaluated against the truth."""
