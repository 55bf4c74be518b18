"""The command line."""

from tests.replay.conftest import omnid

__all__ = ["omnid"]
