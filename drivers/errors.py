"""What a driver raises: one line that says what was asked, what was found and what to do about it."""


class DriverError(Exception):
    """A device or a log cannot be used as it was asked for."""


class BrokenFrame(DriverError):  # noqa: N818 - it is told of a frame, not of the program
    """One image cannot be decoded; the stream that brought it goes on."""
