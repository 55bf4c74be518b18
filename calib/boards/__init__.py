"""Checkerboards, and finding them in mirror images."""
