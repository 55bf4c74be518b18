"""The covariance of a rig's parameters: of both cameras, and of the pose of the upper camera relative to the lower one.

Names: "lower NAME" and "upper NAME" for the intrinsics, in the units of rig.toml (d of an ocam camera moves d and e
alike), then those of TRANSFORM_NAMES. Those describe the upper camera in the rectified frame, while the rig frame stays
with the lower camera: R_true = exp(r) R, viewpoint along (e_x, e_y, 1) at the distance of the baseline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array

# Rotation [rad] and direction of the baseline [rad], in the rectified frame; length of the baseline [m].
TRANSFORM_NAMES = ("r_x", "r_y", "r_z", "e_x", "e_y", "baseline")
# Larger sigmas say nothing of any parameter, and their products overflow.
MAX_SIGMA = 1e6
# Correlations are rounded, so that their text is exact; a matrix may be negative by the rounding.
CORRELATION_DECIMALS, MIN_EIGENVALUE = 12, -1e-9


@dataclass(frozen=True, slots=True)
class RigCovariance:
    """Standard deviations and correlations of named parameters; parameters that were not estimated are not listed."""

    names: tuple[str, ...]
    sigmas: Array  # (P,) in the parameters' own units
    correlation: Array  # (P, P), 1 on the diagonal

    def __post_init__(self) -> None:
        count = len(self.names)
        if not count or len(set(self.names)) != count:
            raise CalibError(f"covariance: expected different parameters, found {count}")
        if self.sigmas.shape != (count,) or self.correlation.shape != (count, count):
            raise CalibError(
                f"covariance: expected {count} sigmas and {count} x {count} correlations, found "
                f"{self.sigmas.shape} and {self.correlation.shape}"
            )
        if not ((self.sigmas >= 0) & (self.sigmas <= MAX_SIGMA)).all():
            raise CalibError(f"covariance: expected sigmas of 0 to {MAX_SIGMA:g}")
        unit = np.isfinite(self.correlation).all() and (np.diag(self.correlation) == 1).all()
        if not unit or (self.correlation != self.correlation.T).any() or np.abs(self.correlation).max() > 1:
            raise CalibError("covariance: expected symmetric correlations between -1 and 1")
        if np.linalg.eigvalsh(self.correlation)[0] < MIN_EIGENVALUE:
            raise CalibError("covariance: the correlations contradict each other (a negative variance)")

    @staticmethod
    def of_matrix(names: Sequence[str], matrix: Array) -> RigCovariance:
        """Return the covariance of a matrix (P, P) in the parameters' own units."""
        sigmas = np.sqrt(np.maximum(0.0, np.diag(matrix)))
        scale = np.where(sigmas > 0, sigmas, 1.0)
        correlation = np.clip(matrix / np.outer(scale, scale), -1, 1).round(CORRELATION_DECIMALS)
        correlation = np.tril(correlation, -1) + np.tril(correlation, -1).T + np.eye(len(names))
        return RigCovariance(tuple(names), sigmas, correlation)

    @property
    def matrix(self) -> Array:
        """Return the covariance matrix (P, P) in the parameters' own units."""
        return np.asarray(self.correlation * np.outer(self.sigmas, self.sigmas))

    def sigma(self, name: str) -> float:
        """Return the standard deviation of a parameter; CalibError if it is not listed."""
        return float(self.sigmas[self._index(name)])

    def select(self, names: Sequence[str]) -> RigCovariance:
        """Return the (marginal) covariance of some parameters, in their order; CalibError if one is not listed."""
        chosen = [self._index(name) for name in names]
        return RigCovariance(tuple(names), self.sigmas[chosen], self.correlation[np.ix_(chosen, chosen)])

    def _index(self, name: str) -> int:
        if name not in self.names:
            raise CalibError(f"covariance: no parameter {name!r}; it has {', '.join(self.names)}")
        return self.names.index(name)
