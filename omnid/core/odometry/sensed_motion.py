"""Motion between two instants by the samples of wheels and gyro: integrals of their rates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3

Array = NDArray[np.float64]

LONGEST_GAP_S = 0.15  # Longest gap between samples, and before the end of an interval.
MOST_SAMPLES = 512  # Samples that are kept, so that memory is bounded: two seconds of a sensor of 250 Hz.


class RateIntegral(NamedTuple):
    """Integral (size,) of the rates of a sensor over an interval, and their change (size,) from start to end."""

    amounts: Array
    changes: Array


class RateHistory:
    """The newest samples of one sensor: times [s] and rates, in the order of the times."""

    def __init__(self, size: int) -> None:
        """size: numbers of a sample."""
        self._times, self._rates = np.zeros(0), np.zeros((0, size))

    def add(self, times_s: Array, rates: Array) -> None:
        """Add samples at times (N,) with rates (N, size); one at a known time replaces the other."""
        times, first = np.unique(np.concatenate([times_s, self._times]), return_index=True)
        rates = np.concatenate([rates, self._rates])[first]
        self._times, self._rates = times[-MOST_SAMPLES:], rates[-MOST_SAMPLES:]

    def integral(self, start_s: float, end_s: float) -> RateIntegral | None:
        """Return the integral of the rates over an interval.

        The rates are linear between samples. None where the samples leave a gap.
        """
        first = int(np.searchsorted(self._times, start_s, side="right")) - 1
        last = int(np.searchsorted(self._times, end_s, side="left"))
        if first < 0 or end_s <= start_s:
            return None
        inner = slice(first, min(last + 1, len(self._times)))
        known = self._times[inner]
        if np.diff(known).max(initial=0.0) > LONGEST_GAP_S or end_s - known[-1] > LONGEST_GAP_S:
            return None
        times = np.concatenate([[start_s], known[(known > start_s) & (known < end_s)], [end_s]])
        rates = np.column_stack([np.interp(times, known, column) for column in self._rates[inner].T])
        total = ((rates[1:] + rates[:-1]) / 2 * np.diff(times)[:, None]).sum(axis=0)
        return RateIntegral(total, rates[-1] - rates[0])

    def missing_s(self, end_s: float) -> float:
        """Return the time before the end of an interval over which `integral` holds the rates of the last sample."""
        return max(0.0, end_s - float(self._times[-1])) if len(self._times) else 0.0

    def largest(self, start_s: float, end_s: float, zero: Array) -> Array | None:
        """Return the largest differences (size,) of the rates in an interval from zero (size,); None if empty."""
        inner = self._rates[(self._times >= start_s) & (self._times <= end_s)] - zero
        return np.asarray(np.abs(inner).max(axis=0)) if len(inner) else None


@dataclass(frozen=True, slots=True)
class SensedMotion:
    """Motion of the rectified frame from one pair to the next by wheels and gyro, as a twist over the whole step."""

    twist: Array  # (6,) [t; r] m, rad: T_prev_curr = exp(twist), an arc for a base on wheels
    noise: Array  # (6, 6) covariance of the twist by errors that are independent from step to step
    systematic: Array  # (6, 6) by errors that are the same in all steps, of scales and bias
    is_complete: bool  # distance and turn are known: the position follows from it

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of the twist by all errors."""
        return self.noise + self.systematic

    @property
    def T_prev_curr(self) -> Array:
        """The motion (4, 4)."""
        return se3.exp(self.twist)
