"""The daemon's one error class for everything a user can put right."""


class OmnidError(Exception):
    """What was asked, what was found and what to do, in one line: the command line prints it and exits with 2."""
