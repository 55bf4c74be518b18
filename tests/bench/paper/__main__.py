"""The paper's experiments: `python -m tests.bench.paper render NAME --seed N --out DIR`, then `... measure DIR`.

Scenes are those of section V: bricks, a control and a smooth wall (fig. 8), turns (fig. 7), a path between two walls
(fig. 9), once around a building (fig. 10).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from omnid.engine.kernel_cache import prepare_kernels
from tests.bench.paper import measures
from tests.bench.paper.povray import INSTALL, PovrayError, available, shoot, write_world
from tests.bench.paper.scenes import EXPERIMENTS
from tests.bench.paper.views import DESCRIPTION, RENDERERS, Experiment
from tests.bench.results import Column, ResultTable
from tests.simulation.logs import pack_log, write_log
from tests.simulation.recipes import SimulatedRun

WHERE: Final = (Column("scene"), Column("method"))
WALL: Final = ResultTable(
    "paper_walls",
    "Matches on a wall (V.B, fig. 8)",
    (
        *WHERE,
        Column("matches a pair", "", 0),
        *(Column(name, "%", 1) for name in ("over 5 cm off", "over 20 cm off", "completeness", "coverage")),
        Column("RMS of the right ones", "mm", 1),
    ),
)
TURNS: Final = ResultTable(
    "paper_turns",
    "Features through turns, of 500 (IV.F, fig. 7)",
    (
        Column("scene"),
        Column("turn", "deg", 0),
        Column("moved"),
        *(Column(f"{name}: {what}") for name in measures.TRACKERS for what in ("right", "claimed")),
    ),
)
PATHS: Final = ResultTable(
    "paper_paths",
    "The path between two walls (V.C, fig. 9), and around a building (V.D, fig. 10)",
    (
        *WHERE,
        Column("length", "%", 3),
        Column("ATE rmse", "mm", 2),
        Column("end", "mm", 2),
        Column("heading, max", "deg", 3),
        Column("map, RMS", "mm", 1),
        Column("map, over 5 cm off", "%", 2),
        Column("walls mapped", "%", 1),
    ),
)


def measure_log(folder: Path) -> None:
    """Add the rows of a log."""
    experiment = Experiment.read(folder)
    if experiment.name in ("brick", "control", "smooth"):
        for method, figures in measures.walls(folder, experiment).items():
            WALL.add(experiment.label, method, *figures)
    elif experiment.name == "turns":
        for turn in measures.turns(folder, experiment):
            counts = [count[name] for name in measures.TRACKERS for count in (turn.right, turn.claimed)]
            TURNS.add(experiment.label, turn.angle_deg, turn.is_moved, *counts)
    else:
        only = (measures.THE_PAPER, measures.OMNID) if experiment.name == "building" else tuple(measures.METHODS)
        for method in only:
            PATHS.add(experiment.label, method, *measures.path(folder, experiment, method))


def measure(arguments: argparse.Namespace) -> None:
    """Measure each log of the folder."""
    prepare_kernels()
    for description in sorted(arguments.logs.glob(f"*/{DESCRIPTION}")):
        measure_log(description.parent)


def trace_log(folder: Path, run: SimulatedRun, seed: int, supersample: int) -> None:
    """Write the log of a run whose images POV-Ray traces, with its truth."""
    cameras = (run.rig.lower, run.rig.upper)
    with TemporaryDirectory() as work:
        world = Path(work)
        write_world(world, run.scene)
        pack_log(
            folder,
            run.rig,
            run.poses,
            lambda pair, camera: shoot(world, cameras[camera], run.poses[pair], supersample),
            sensor=run.sensor,
            seed=seed,
        )


def render(arguments: argparse.Namespace) -> None:
    """Render the scene for every seed."""
    if arguments.renderer == "povray" and not available():
        raise PovrayError(f"povray is not installed: {INSTALL}")
    for seed in arguments.seed:
        pairs = arguments.pairs or EXPERIMENTS[arguments.name][1]
        experiment = Experiment(arguments.name, seed, arguments.size, pairs, arguments.renderer)
        folder, run = arguments.out / experiment.label, experiment.run
        experiment.write(folder)
        if arguments.renderer == "povray":
            trace_log(folder, run, seed, arguments.supersample)
        else:
            write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=seed)


def main() -> None:
    """Render the scenes of the paper's experiments, or measure the paper's and omnid's methods on them."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.paper", description=main.__doc__)
    commands = parser.add_subparsers(required=True, metavar="command")
    add = commands.add_parser("render", help="render one scene")
    add.add_argument("name", choices=sorted(EXPERIMENTS))
    add.add_argument("--seed", type=int, nargs="+", default=[11], help="seeds of textures, path and rig")
    add.add_argument("--out", type=Path, required=True, help="folder for NAME_sSEED/log.mcap and its truth")
    add.add_argument("--renderer", choices=RENDERERS, default="povray", help="ray_caster: several times faster")
    add.add_argument("--size", type=int, default=768, help="width and height of the images [px]")
    add.add_argument("--pairs", type=int, help="number of stereo pairs")
    add.add_argument("--supersample", type=int, default=2, help="samples per pixel and axis")
    add.set_defaults(run=render)
    add = commands.add_parser("measure", help="measure the rendered logs and print tables")
    add.add_argument("logs", type=Path, help="the folder given to render as --out")
    add.set_defaults(run=measure)
    arguments = parser.parse_args()
    try:
        arguments.run(arguments)
    except PovrayError as error:
        sys.exit(f"tests.bench.paper: {error}")


if __name__ == "__main__":
    main()
