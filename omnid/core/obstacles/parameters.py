"""The numbers of the method, each a probability, a rate, a size, a noise or a temperature, in one place.

They were set on drawn corridors of the development seeds 1 to 3.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class GridParameters:
    """The grid of cells; log-odds in nats."""

    prior: float = -4.6  # of a thing in a cell
    floor: float = -7.0  # of a cell by whose look floor is known
    arrival: float = -9.0  # least log-odds, as something may come into each cell in each pair
    most: float = 6.0
    views: float = 3.0  # n: views of a place that count
    same_place: float = 0.9  # rho: correlation of the errors of pairs from one place,
    apart_m: float = 0.05  # and the way after which they are independent
    risk: float = 0.1  # probability of a thing on a way that is free
    walk_mps: float = 1.6  # of who may come where nobody sees
    person_cells: int = 5  # width of who may
    strut_rad: float = 0.26  # widest part of the view that a strut or a mast hides
    person_rad: float = 0.65  # angle of a person nearer than the floor in view: 0.4 m at 0.6 m
    thin_m: float = 0.035  # width of the thinnest thing
    hidden: float = 0.5  # probability of a thing in the nearest bins by which they are hidden,
    near_m: float = 0.06  # and the length of these bins
    comes: float = 2.0  # by which one pair shows a thing that has come [nats]
    was_free: float = 0.01  # probability of a thing in a cell that was free,
    lately_s: float = 3.0  # and for how long that counts
    comes_m: float = 0.2  # least width of who comes,
    behind_m: float = 0.15  # and of floor that was free behind its front, beside three sigmas of a disparity
    near_sigma: float = 0.3  # of the range of what hides the nearest floor in view, as a share
    hanging: float = -5.0  # log-odds of something that hangs over floor in view
    shown_rate: float = 0.15  # of the mean of single pairs
    shown_least: float = 0.025  # mean from which something hangs there,
    shown_weight: float = 100.0  # and its log-odds by this mean
