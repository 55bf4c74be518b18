"""Floors and what stands on them, drawn into panoramas of two cameras above each other, and seen place by place."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from calib.panorama import Cylinder
from omnid.core.obstacles.floor_view import FloorView
from omnid.core.types.panorama import PaddedPanorama

HEIGHT_M, BASELINE_M = 0.9, 0.2
CYLINDER = Cylinder(872, 253, 86.0)
PAD_PX = 24
T_RECT_BASE = np.eye(4)
T_RECT_BASE[2, 3] = -HEIGHT_M
Pattern = Callable[[np.ndarray, np.ndarray], np.ndarray]


def tiles(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return grey levels of tiles that differ little from each other."""
    number = np.floor(x_m / 0.3).astype(int) * 7 + np.floor(y_m / 0.3).astype(int) * 13
    return np.asarray(120.0 + 8.0 * np.sin(number * 2.4))


def worn(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return grey levels of a floor whose stains differ by less than stereo needs."""
    return np.asarray(120.0 + 3.0 * (np.sin(31 * x_m + 3) * np.sin(23 * y_m) + np.sin(17 * x_m - 29 * y_m)
                                     + np.sin(13 * x_m + 37 * y_m)))


def plain(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return one grey level."""
    return np.full(np.shape(x_m), 120.0)


class Pillar(NamedTuple):
    """A round pillar higher than the cameras; x, y in odom."""

    x_m: float
    y_m: float
    radius_m: float
    grey: float = 170.0

    def hides(self, from_m: np.ndarray, places: np.ndarray) -> np.ndarray:
        """True for places (N, 2) in odom that stand in it or behind it, as seen from a point (2,)."""
        way, towards = places - from_m, np.array([self.x_m, self.y_m]) - from_m
        length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
        along = way @ towards / length
        across = np.sqrt(np.maximum(towards @ towards - along**2, 0.0))
        return (across < self.radius_m) & (along > 0) & (length > along - self.radius_m)


class SeenFloor:
    """The looks of a floor from 0.8 m on, as `FloorCamera.view` returns them."""

    def __init__(self, pattern: Pattern = tiles) -> None:
        self.pattern, self.pillars, self.gain, self.noise_grey = pattern, [], 1.0, 1.0
        self.pillars: list[Pillar]
        self._rng = np.random.default_rng(3)

    def at(self, T_odom_base: np.ndarray) -> Callable[[np.ndarray], FloorView]:
        """Return the view from a pose."""

        def view(places: np.ndarray) -> FloorView:
            in_odom = places @ T_odom_base[:2, :2].T + T_odom_base[:2, 3]
            grey = self.pattern(*in_odom.T)
            for pillar in self.pillars:
                grey = np.where(pillar.hides(T_odom_base[:2, 3], in_odom), pillar.grey, grey)
            in_view = np.linalg.norm(places, axis=1) > 0.8
            grey = self.gain * grey + self._rng.normal(0.0, self.noise_grey / 5, len(grey))
            return FloorView(np.where(in_view, grey, np.nan).astype(np.float32), in_view, self.noise_grey)

        return view


def blind(places: np.ndarray) -> FloorView:
    """Return the view of cameras that see no floor."""
    return FloorView(np.full(len(places), np.nan, np.float32), np.zeros(len(places), bool))


def panoramas(floor: Pattern, wall_m: float, wall: Pattern) -> tuple[PaddedPanorama, PaddedPanorama]:
    """Return the lower and the upper panorama of a floor with a round wall; wall: grey of azimuth and height."""
    rng = np.random.default_rng(4)
    return tuple(_drawn(height, floor, wall_m, wall, rng)
                 for height in (HEIGHT_M, HEIGHT_M + BASELINE_M))  # type: ignore[return-value]


def _drawn(height_m: float, floor: Pattern, wall_m: float, wall: Pattern, rng: np.random.Generator) -> PaddedPanorama:
    columns, rows = np.meshgrid(np.arange(CYLINDER.width), np.arange(CYLINDER.height))
    rays = CYLINDER.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    with np.errstate(divide="ignore"):
        r = np.where(rays[:, 2] < 0, -height_m / rays[:, 2], np.inf)
    near = np.minimum(r, wall_m)
    x, y, z = (near * rays.T[i] for i in range(3))
    grey = np.where(r < wall_m, floor(x, y), wall(np.arctan2(y, x), height_m + z))
    image = grey.reshape(columns.shape) + rng.normal(0.0, 1.0, columns.shape)
    padded = np.pad(np.clip(np.rint(image), 0, 255).astype(np.uint8), ((0, 0), (PAD_PX, PAD_PX)), mode="wrap")
    return PaddedPanorama(padded, PAD_PX, noise_grey=1.0)
