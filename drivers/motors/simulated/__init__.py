"""Simulated motor controllers that use the protocols' real bytes: digital twins for demonstrations and tests."""
