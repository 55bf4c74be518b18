"""The trials of the live daemon, in the order of the table."""

from __future__ import annotations

from tests.replay.faults import bus, cameras, controller, host  # noqa: F401 - each enters its trials
from tests.replay.faults.trial import TRIALS, Place

__all__ = ["TRIALS", "Place"]
