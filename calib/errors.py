"""Errors of calibration files and calibrations."""


class CalibError(Exception):
    """An unusable calibration file or value; its text is one line: what was expected, what was found, what to do."""
