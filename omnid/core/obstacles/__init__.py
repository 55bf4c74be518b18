"""Obstacles around the base: ring of ranges from stereo, its filter over time, moving obstacles."""
