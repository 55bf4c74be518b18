"""Logs: MCAP files read, written, repaired and rotated."""
