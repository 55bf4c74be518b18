"""`python -m tests.experiments render NAME --seed N --out DIR`, then `python -m tests.experiments report DIR`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tests.experiments.povray import INSTALL, PovrayError, available
from tests.experiments.rendering import cast_log, render_log
from tests.experiments.report import RESULTS, report
from tests.experiments.scenes import EXPERIMENTS, RigOptions
from tests.experiments.views import RENDERERS, Experiment


def main() -> None:
    """Render the scenes of the paper's experiments and measure the paper's and omnid's methods on them."""
    parser = argparse.ArgumentParser(prog="python -m tests.experiments", description=main.__doc__)
    commands = parser.add_subparsers(required=True, metavar="command")
    _add_render(commands.add_parser("render", help="render one scene, or continue an interrupted rendering"))
    _add_report(commands.add_parser("report", help="measure the rendered logs; write tables and figures"))
    arguments = parser.parse_args()
    try:
        arguments.run(arguments)
    except PovrayError as error:
        sys.exit(f"tests.experiments: {error}")


def _add_render(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", choices=sorted(EXPERIMENTS))
    parser.add_argument("--seed", type=int, nargs="+", default=[11], help="seeds of textures, path and rig")
    parser.add_argument("--out", type=Path, required=True, help="folder for NAME_sSEED/log.mcap and its truth")
    parser.add_argument(
        "--renderer",
        choices=RENDERERS,
        default="povray",
        help="ray_caster: the renderer of tests/simulation, several times faster than POV-Ray",
    )
    parser.add_argument("--size", type=int, default=768, help="width and height of the images [px]")
    parser.add_argument("--pairs", type=int, help="number of stereo pairs")
    parser.add_argument("--supersample", type=int, default=2, help="samples per pixel and axis")
    parser.add_argument("--jobs", type=int, default=2, help="images that POV-Ray renders at a time")
    parser.add_argument("--scale", type=float, help="mirror scale: radius of the horizon, 1 = 27 %% of the width")
    parser.add_argument("--baseline-m", type=float, help="height of the upper viewpoint above the lower one [m]")
    parser.add_argument("--misaligned", type=float, help="misalignment of the rig: 0 none, 1 up to 1.2 deg and 4 mm")
    parser.add_argument("--xi", type=float, default=1.0, help="1: parabolic mirrors; below: hyperbolic ones")
    parser.set_defaults(run=render)


def render(arguments: argparse.Namespace) -> None:
    """Render the scene for every seed."""
    if arguments.renderer == "povray" and not available():
        raise PovrayError(f"povray is not installed: {INSTALL}")
    options = RigOptions(arguments.scale, arguments.baseline_m, arguments.misaligned, arguments.xi)
    for seed in arguments.seed:
        pairs = arguments.pairs or EXPERIMENTS[arguments.name][1]
        experiment = Experiment(arguments.name, seed, arguments.size, pairs, options, arguments.renderer)
        folder = arguments.out / experiment.label
        experiment.write(folder)
        if arguments.renderer == "povray":
            render_log(folder, experiment.run, seed, supersample=arguments.supersample, jobs=arguments.jobs)
        else:
            cast_log(folder, experiment.run, seed, supersample=arguments.supersample)


def _add_report(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", type=Path, help="the folder given to render as --out")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for tables, figures and numbers")
    parser.add_argument("--again", action="store_true", help="measure also logs that have results")
    parser.set_defaults(run=lambda arguments: report(arguments.logs, arguments.results, arguments.again))


if __name__ == "__main__":
    main()
