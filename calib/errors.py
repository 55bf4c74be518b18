"""What goes wrong with a calibration."""


class CalibError(Exception):
    """A calibration file or value that cannot be used; one line: asked, found, what to do."""
