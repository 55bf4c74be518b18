"""Noise as a mixture of two Gaussian distributions against the Cauchy kernel, in Gauss-Newton.

`python -m tests.experiments.mixture_noise [FOLDER ...]` prints a table of simulated views, and then one of the logs of
`python -m tests.simulation`. The mixture is the future work of Dang et al. 2012; its maximum is taken in the place of
its sum (max-mixture: Olson and Agarwal 2013, "Inference on networks of mixtures for robust robot mapping").
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.compiled import Kernel, inner
from omnid.core.odometry import pose_kernels
from omnid.core.odometry.pose_estimation import gauss_newton, ransac
from omnid.core.stereo.triangulation import point_covariance, view
from omnid.core.types.stereo_model import StereoModel
from tests.benchmark.accuracy import COLUMNS, row
from tests.benchmark.results import Column, ResultTable

Array = NDArray[np.float64]
Weigh = Callable[[float], float]

DIMENSIONS: Final = 3  # of a view
OUTLIERS: Final = 0.1  # share of the wide component
WIDTH: Final = 10.0  # its standard deviation, relative to that of the narrow one
MODEL: Final = StereoModel(Cylinder(1304, 378, 170.0), 0.24, 0.1)
LANDMARKS: Final = 300
THRESHOLD_PX: Final = 2.0
RUNS: Final = 200


def mixture_weight(squared: float) -> float:
    """Return the weight of a view by that component which explains it best."""
    gain = 2 * (math.log((1 - OUTLIERS) / OUTLIERS) + DIMENSIONS * math.log(WIDTH))
    return 1.0 if squared * (1 - WIDTH**-2) < gain else WIDTH**-2


KERNELS: Final[Mapping[str, Weigh]] = {"Cauchy": pose_kernels.robust_weight, "mixture": mixture_weight}


@cache
def gauss_newton_with(weigh: Weigh) -> Kernel[..., None]:
    """Return Gauss-Newton, compiled with another kernel."""
    before = pose_kernels.robust_weight, pose_kernels.accumulate
    of_cauchy = pose_kernels.gauss_newton
    pose_kernels.robust_weight, pose_kernels.accumulate = inner(weigh), inner(before[1].function)
    compiled = Kernel(of_cauchy.function, of_cauchy.arguments)
    try:
        compiled.load(compiled.code())
    finally:
        pose_kernels.robust_weight, pose_kernels.accumulate = before
    return compiled


@contextmanager
def kernel(weigh: Weigh) -> Iterator[None]:
    """Let Gauss-Newton weigh by another kernel in this block."""
    before = pose_kernels.gauss_newton
    if weigh is not pose_kernels.robust_weight:
        pose_kernels.gauss_newton = gauss_newton_with(weigh)
    try:
        yield
    finally:
        pose_kernels.gauss_newton = before


def clean(rng: np.random.Generator, views: Array) -> Array:
    """Return the views as they are."""
    return views


def crowded(rng: np.random.Generator, views: Array) -> Array:
    """Return views of which a third moved with people: all in one direction, by 1 to 4 px."""
    moved = rng.random(len(views)) < 1 / 3
    return views + moved[:, None] * (rng.uniform(1, 4) * np.array([1.0, 0.1, 0.1]))


def repetitive(rng: np.random.Generator, views: Array) -> Array:
    """Return views of which a fifth was matched one period aside: by 3 px in the column, to either side."""
    wrong = rng.random(len(views)) < 0.2
    return views + wrong[:, None] * np.outer(rng.choice([-3.0, 3.0], len(views)), [1.0, 0.0, 0.0])


def sloppy(rng: np.random.Generator, views: Array) -> Array:
    """Return views with heavy tails: a quarter has five times the noise."""
    poor = rng.random(len(views)) < 0.25
    return views + poor[:, None] * rng.normal(0, 5 * MODEL.sigma_px, views.shape)


KINDS: Final = {"clean": clean, "crowded": crowded, "repetitive": repetitive, "heavy tails": sloppy}


def errors(kind: str, weigh: Weigh, runs: int = RUNS) -> tuple[float, float, float]:
    """Return the root mean squares of position [mm] and rotation [mrad] errors, and the mean squared Mahalanobis
    distance, which is 6 where the covariance is right.
    """
    found = []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        angle, r = rng.uniform(-math.pi, math.pi, LANDMARKS), rng.uniform(1.5, 6.0, LANDMARKS)
        truth = np.column_stack([r * np.cos(angle), r * np.sin(angle), rng.uniform(-0.5, 0.8, LANDMARKS) * r / 3])
        spread = point_covariance(truth, MODEL.cylinder, MODEL.baseline_m, MODEL.sigma_px)
        landmarks = truth + np.einsum("nij,nj->ni", np.linalg.cholesky(spread), rng.normal(size=truth.shape))
        T = se3.exp([0.1, 0.02, 0.0, 0.0, 0.0, 0.05])
        views = view(se3.apply(T, truth), MODEL.cylinder, MODEL.baseline_m)
        views = KINDS[kind](rng, views + rng.normal(0, MODEL.sigma_px, views.shape))
        start, inlier = ransac(landmarks, views, MODEL, rng, THRESHOLD_PX)
        with kernel(weigh):
            result = gauss_newton(landmarks[inlier], spread[inlier], views[inlier], start, MODEL, steps=8)
        error = se3.log(T @ se3.inverse(result.T))
        found.append([error[:3] @ error[:3], error[3:] @ error[3:], error @ np.linalg.solve(result.covariance, error)])
    position, rotation, squared = np.mean(found, axis=0)
    return 1e3 * math.sqrt(position), 1e3 * math.sqrt(rotation), float(squared)


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="*", metavar="FOLDER")
    args = parser.parse_args()
    columns = (
        Column("views"),
        Column("kernel"),
        Column("position", "mm", 3),
        Column("rotation", "mrad", 3),
        Column("squared distance, expected 6", "", 3),
    )
    table = ResultTable("mixture_views", "accuracy", "Noise as a mixture of two Gaussians: simulated views", columns)
    for kind in KINDS:
        for name, weigh in KERNELS.items():
            table.add(kind, name, *errors(kind, weigh))
    if args.folders:
        table = ResultTable(
            "mixture_logs", "accuracy", "Noise as a mixture of two Gaussians: logs", (Column("kernel"), *COLUMNS)
        )
    for folder in args.folders:
        for name, weigh in KERNELS.items():
            with kernel(weigh):
                table.add(name, *row(folder, ["places.enabled=false"]), folder=folder)


if __name__ == "__main__":
    main()
