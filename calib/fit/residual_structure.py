"""Systematic part of residuals: their mean by radius and azimuth, compared with their scatter about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.fit.least_squares import KERNEL_WIDTH
from calib.models.camera import Array

# Bins of the image: rings with equal numbers of corners, and sectors of azimuth.
RINGS, SECTORS = 6, 12
# A misfit is reported if the systematic part exceeds this part of the noise, and this error, because smaller ones do
# not change the motion estimate by a measurable amount.
MAX_SYSTEMATIC_PART, MAX_SYSTEMATIC_PX = 0.5, 0.03


@dataclass(frozen=True, slots=True)
class ResidualStructure:
    """Systematic part and noise of residuals [px], per coordinate (rms).

    systematic_px: the mean residual as a function of the image position, common to all views. noise_px: the scatter
    about that.
    """

    systematic_px: float
    noise_px: float

    @property
    def is_misfit(self) -> bool:
        """True if the model leaves more than the noise explains."""
        return self.systematic_px > max(MAX_SYSTEMATIC_PART * self.noise_px, MAX_SYSTEMATIC_PX)

    def __str__(self) -> str:
        return f"systematic residuals of {self.systematic_px:.3f} px, noise of {self.noise_px:.3f} px"


def residual_structure(pixels: Array, residuals: Array, center: tuple[float, float]) -> ResidualStructure:
    """Return the structure of residuals (N, 2) at pixels (N, 2) [px], in bins about the center; NaN ones are left out.

    A one-way analysis of variance with the bins as groups.
    """
    length = np.linalg.norm(residuals, axis=1)
    # Outliers are twice as far as the kernel reaches, by the median length: 3 of 100 million of a normal distribution.
    known = (
        length < 2 * KERNEL_WIDTH * np.nanmedian(length) if np.isfinite(length).any() else np.zeros(len(length), bool)
    )
    offset, residuals = pixels[known] - center, residuals[known]
    bins = _bins(offset)
    # Radial and tangential components, so that an error that depends on the radius alone is the same in all sectors.
    radial = offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1.0)
    tangential = np.column_stack([-radial[:, 1], radial[:, 0]])
    components = np.column_stack([(residuals * radial).sum(axis=1), (residuals * tangential).sum(axis=1)])
    between, within, groups, used = 0.0, 0.0, 0, len(components)
    for number in np.unique(bins):
        group = components[bins == number]
        mean = group.mean(axis=0)
        between += len(group) * float((mean**2).sum())
        within += float(((group - mean) ** 2).sum())
        groups += 1
    if used <= groups:
        return ResidualStructure(0.0, float("inf"))
    variance = within / (2 * (used - groups))
    systematic = np.sqrt(max(0.0, between / (2 * used) - groups / used * variance))
    return ResidualStructure(float(systematic), float(np.sqrt(variance)))


def _bins(offset: Array) -> Array:
    """Return the bin number (N,) of offsets (N, 2) from the centre."""
    radius, azimuth = np.linalg.norm(offset, axis=1), np.arctan2(offset[:, 1], offset[:, 0])
    edges = np.quantile(radius, np.linspace(0, 1, RINGS + 1)[1:-1]) if len(radius) else np.zeros(RINGS - 1)
    sector = np.floor((azimuth + np.pi) / (2 * np.pi) * SECTORS).clip(0, SECTORS - 1)
    return np.asarray(np.searchsorted(edges, radius) * SECTORS + sector, float)
