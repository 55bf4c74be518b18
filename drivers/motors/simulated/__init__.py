"""Simulated motor controllers, byte for byte, for demonstrations and tests."""
