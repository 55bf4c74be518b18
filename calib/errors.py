"""Errors of calibration files and calibrations."""


class CalibError(Exception):
    """A calibration file or value that cannot be used; one line: what was expected, what was found, what to do."""
