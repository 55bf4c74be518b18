"""The error class for everything that a user can correct."""


class OmnidError(Exception):
    """An error that the user can correct: what failed, what was expected and what to do, in one line."""
