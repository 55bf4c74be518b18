"""The numbers of the method, each a probability, a rate, a size, a noise or a temperature, in one place.

They were set on drawn corridors of the development seeds 1 to 3.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RayParameters:
    """The posterior of rays; log-likelihood ratios in nats."""

    # Rates of the prior, per metre of a ray.
    things_per_m: float = 0.1
    hanging_per_m: float = 0.05
    steps_per_m: float = 0.005
    slopes_per_m: float = 0.05
    changes_per_m: float = 0.02  # of borders behind which the floor looks otherwise
    # Probabilities.
    alike: float = 0.1  # something looks like the floor
    invisible: float = 0.005  # the end of the floor beyond the last bin shows no foot
    nearer: float = 0.02  # something begins nearer than the view and looks like the floor,
    nearer_other: float = 0.03  # or otherwise
    marks: float = 0.02  # m: an edge in a bin of the floor, before any was seen; worth so many bins:
    marks_bins: float = 40.0
    seen_bins: float = 100.0  # what bins are worth that were seen
    marks_behind: float = 0.2  # an edge in a bin of what hides the floor,
    marks_plain: float = 0.01  # and of something plain
    plain_behind: float = 0.3  # what hides the floor has no texture
    tail: float = 0.05  # a step of the floor has 2.5 times its sigma
    # Noises and scales.
    contrast: float = 0.15  # b: of the difference of grey between a thing and the floor, by the floor's grey
    surface_noise: float = 0.4  # of the best surface where there is none [nats]
    noise_share: float = 0.4  # sigma of a step by noise alone, by the noise of a pixel of both views
    grey_share: float = 0.06  # least sigma of the floor's grey, by the grey,
    near_grey_share: float = 0.01  # and where it is known at that range
    # Temperatures, as neighbouring bins and directions are not independent.
    w_floor: float = 0.15
    w_edge: float = 0.5
    w_level: float = 0.3
    w_look: float = 0.2
    # Bounds of what one bin says [nats].
    floor_low: float = -12.0
    floor_high: float = 8.0
    level_most: float = 4.0
    surface_most: float = 8.0
    look_low: float = -2.5
    look_high: float = 1.0
    grey_low: float = -5.0  # of a grey where the floor's is known at that range
    cell_low: float = -3.0
    cell_high: float = 4.0
    # Surfaces: where the mean over so many directions is largest, it counts so much more than one direction.
    wide_columns: int = 11
    wide_weight: float = 5.0
    # Look of the floor: learned up to this range [m], from so many bins at least.
    look_m: float = 1.8
    look_bins: int = 100


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
