"""What goes wrong with a device or a log."""


class DriverError(Exception):
    """A device or log that cannot be used; one line: asked, found, what to do."""
