"""Ring of obstacles as the collision monitor needs it: ranges, free ways, and what moves."""

from __future__ import annotations

from typing import NamedTuple


class MovingPoint(NamedTuple):
    """A moving obstacle in the base frame of its ring, whose axes do not move; m, m/s."""

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    radius_m: float
    sigma_m: float = 0.0  # standard deviation of the place
    sigma_mps: float = 0.0  # standard deviation of the velocity


class ControllerRing(NamedTuple):
    """The part of an obstacle ring that the monitor needs; sector k is about azimuth -pi + (k + 0.5) 2 pi / N."""

    stamp_ns: int  # time of the capture
    ranges_m: tuple[float, ...]  # (N,) inf: free, NaN: unknown
    free_m: tuple[float, ...] = ()  # (N,) up to which a direction was seen to be free; empty: the range, 0 if unknown
    moving: tuple[MovingPoint, ...] = ()
    unwatched: tuple[bool, ...] = ()  # (N,) the images show nothing to rely on there; empty: they do everywhere
