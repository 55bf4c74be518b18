"""The paper's experiments: `python -m tests.bench.paper render NAME --seed N --out DIR`, then `... measure DIR`.

Scenes are those of section V: bricks (fig. 8), turns (fig. 7), a path between two walls
(fig. 9), once around a building (fig. 10).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from omnid.engine.kernel_cache import prepare_kernels
from tests.bench.paper import measures
from tests.bench.paper.scenes import DESCRIPTION, EXPERIMENTS, Experiment
from tests.bench.results import ResultTable, columns, run
from tests.simulation.logs import write_log


def measure(logs: Path) -> None:
    """Measure the paper's and omnid's methods on the rendered logs of a folder, and print tables."""
    prepare_kernels()
    where = ("scene", "method")
    walls = ResultTable(
        "paper_walls",
        "Matches on a wall (V.B, fig. 8)",
        columns(
            *(*where, "matches a pair||0", "over 5 cm off|%|1", "over 20 cm off|%|1", "completeness|%|1"),
            *("coverage|%|1", "RMS of the right ones|mm|1"),
        ),
    )
    turns = ResultTable(
        "paper_turns",
        "Features through turns, of 500 (IV.F, fig. 7)",
        columns(
            *("scene", "turn|deg|0"),
            *(f"{name}: {what}" for name in measures.TRACKERS for what in ("right", "claimed")),
        ),
    )
    paths = ResultTable(
        "paper_paths",
        "The path between two walls (V.C, fig. 9), and around a building (V.D, fig. 10)",
        columns(
            *(*where, "length|%|3", "ATE rmse|mm|2", "end|mm|2", "heading, max|deg|3"),
        ),
    )
    for description in sorted(logs.glob(f"*/{DESCRIPTION}")):
        folder, experiment = description.parent, Experiment.read(description.parent)
        if experiment.name == "brick":
            for method, figures in measures.walls(folder, experiment).items():
                walls.add(experiment.label, method, *figures)
        elif experiment.name == "turns":
            for turn in measures.turns(folder, experiment):
                counts = [count[name] for name in measures.TRACKERS for count in (turn.right, turn.claimed)]
                turns.add(experiment.label, turn.angle_deg, *counts)
        else:
            only = (measures.THE_PAPER, measures.OMNID) if experiment.name == "building" else tuple(measures.METHODS)
            for method in only:
                paths.add(experiment.label, method, *measures.path(folder, method))


def render(name: str, *, out: Path, seed: Sequence[int] = (11,), size: int = 768, pairs: int = 0) -> None:
    """Render a scene into OUT/NAME_sSEED for every seed; size: of the images [px]; pairs 0: as many as the paper."""
    if name not in EXPERIMENTS:
        raise SystemExit(f"{name}: expected one of {', '.join(EXPERIMENTS)}")
    for number in seed:
        experiment = Experiment(name, number, size, pairs or EXPERIMENTS[name][1])
        made = experiment.run
        experiment.write(out / experiment.label)
        write_log(out / experiment.label, made.rig, made.poses, made.scene, sensor=made.sensor, seed=number)


if __name__ == "__main__":
    run(render, measure)
