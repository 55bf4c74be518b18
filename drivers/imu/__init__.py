"""Inertial measurement units on serial ports."""
