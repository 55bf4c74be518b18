"""Checks of `omnid doctor`; each takes plain values and returns findings."""
