"""Checkerboards and their detection in mirror images."""
