"""Fault injection: the trials of the live daemon, in the order of the table."""

from __future__ import annotations

from tests.bench.faults.trials import bus, cameras, controller, host  # noqa: F401 - each registers its trials
from tests.bench.faults.trials.trial import TRIALS, Outcome, Setting

__all__ = ["TRIALS", "Outcome", "Setting"]
