"""Stamps are whole nanoseconds, durations are seconds: the factor between them."""

from __future__ import annotations

from typing import Final

S_PER_NS: Final = 1e-9  # exact: what the prefix stands for
