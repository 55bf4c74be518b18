"""Exposure of live cameras, by what the mirrors show."""
