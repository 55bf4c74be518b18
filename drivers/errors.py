"""Exceptions of the drivers; each message is one line: what was requested, what was found, what to do."""


class DriverError(Exception):
    """A device or a log that cannot be used as requested."""


class FrameDecodeError(DriverError):
    """An image that cannot be decoded; the stream that delivered it continues."""


class RecordError(FrameDecodeError):
    """A record or a message with invalid content; those after it may be valid. The text identifies the record."""
