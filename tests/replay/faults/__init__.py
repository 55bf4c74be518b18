"""Fault injection: the trials of the live daemon, in the order of the table."""

from __future__ import annotations

from tests.replay.faults import bus, cameras, controller, host  # noqa: F401 - each registers its trials
from tests.replay.faults.trial import TRIALS, Setting

__all__ = ["TRIALS", "Setting"]
