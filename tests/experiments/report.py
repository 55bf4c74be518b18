"""Measure the rendered logs one by one, and write the tables and figures of all results so far."""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import cv2

from tests.experiments import (
    figures,
    path_following,
    report_text,
    speed,
    tables,
    turn_tracking,
    wall_matching,
    whole_building,
)
from tests.experiments.tables import Seeds, Values
from tests.experiments.views import DESCRIPTION, RENDERERS, Experiment

RESULTS = Path(__file__).parent / "results"
Measure = Callable[[Path, Experiment], Values]
MEASURES: dict[str, dict[str, Measure]] = {  # by scene: what is measured on it
    "brick": {"wall": wall_matching.measure},
    "control": {"wall": wall_matching.measure},
    "smooth": {"wall": wall_matching.measure},
    "turns": {"turns": turn_tracking.measure},
    "two_walls": {"paths": path_following.measure, "speed": speed.measure},
    "building": {"building": whole_building.measure},
}
WALLS = ("brick", "control", "smooth")
RENDERER_NAMES = {"povray": "POV-Ray", "ray_caster": "ray caster"}


def report(logs: Path, results: Path = RESULTS, again: bool = False) -> None:
    """Measure each log in a folder that has no result yet (all, if again), and write results/README.md."""
    (results / "data").mkdir(parents=True, exist_ok=True)
    for description in sorted(logs.glob(f"*/{DESCRIPTION}")):
        folder = description.parent
        if not (folder / "log.mcap").exists():
            continue  # rendering has not finished
        experiment = Experiment.read(folder)
        for what, measure in MEASURES[experiment.name].items():
            target = results / "data" / f"{what}_{experiment.label}.json"
            if again or not target.exists():
                sys.stderr.write(f"{target.stem} ...\n")
                _write(target, {**about(experiment), "values": measure(folder, experiment)})
    draw(logs, results)
    (results / "README.md").write_text(text(results))


def about(experiment: Experiment) -> Values:
    """Return the origin of a result: scene, renderer, date and machine."""
    return {
        "scene": experiment.name,
        "seed": experiment.seed,
        "size": experiment.size,
        "pairs": experiment.pairs,
        "renderer": experiment.renderer,
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine(),
    }


def machine() -> str:
    """Return cores, processor and versions in one line."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    return f"{os.cpu_count()} cores, {model}, Python {platform.python_version()}, OpenCV {cv2.__version__}"


def _write(path: Path, content: Values) -> None:
    path.write_text(json.dumps(content, indent=None, separators=(",", ":")) + "\n")


def measured(results: Path, what: str, scene: str, renderer: str) -> Seeds:
    """Return the results of a scene by seed."""
    files = [json.loads(path.read_text()) for path in sorted((results / "data").glob(f"{what}_{scene}_s*.json"))]
    return {file["seed"]: file["values"] for file in files if file["renderer"] == renderer}


def draw(logs: Path, results: Path) -> None:
    """Draw the figures: of the last seed whose log is there, or of all seeds together."""
    if turns := measured(results, "turns", "turns", "povray"):
        rows = [row for values in turns.values() for row in values["turns"] if not row["moved"]]
        figures.turns(rows, results / "turns.png")
    for scene, draw_scene in (("brick", wall_matching.draw), ("building", whole_building.draw)):
        if folder := _last_log(logs, scene):
            draw_scene(folder, Experiment.read(folder), results / f"{scene}.png")
    if folder := _last_log(logs, "two_walls"):
        experiment = Experiment.read(folder)
        values = measured(results, "paths", "two_walls", experiment.renderer)[experiment.seed]
        path_following.draw(values, folder, results / "two_walls.png")


def _last_log(logs: Path, scene: str) -> Path | None:
    """Return the folder of the last seed of a scene whose log is there."""
    folders = sorted(path.parent for path in logs.glob(f"{scene}_s*/log.mcap"))
    return next((folder for folder in reversed(folders) if (folder / DESCRIPTION).exists()), None)


def text(results: Path) -> str:
    """Return the report in Markdown."""
    parts = [report_text.HEAD]
    walls = {scene: seeds for scene in WALLS if (seeds := measured(results, "wall", scene, "povray"))}
    if walls:
        parts += [report_text.WALL, tables.wall_table(walls), report_text.WALL_REMARKS]
    if turns := measured(results, "turns", "turns", "povray"):
        parts += [report_text.TURNS, tables.turns_summary(turns), tables.turns_table(turns), report_text.TURNS_REMARKS]
    parts += _paths(results)
    parts += _building(results)
    for renderer in RENDERERS:
        if times := measured(results, "speed", "two_walls", renderer):
            parts += [report_text.SPEED, tables.speed_table(times), report_text.SPEED_REMARKS]
    return "\n".join([*parts, _provenance(results)])


def _paths(results: Path) -> list[str]:
    found = {renderer: measured(results, "paths", "two_walls", renderer) for renderer in RENDERERS}
    parts = [
        f"{RENDERER_NAMES[renderer]}, seeds {', '.join(map(str, sorted(seeds)))}:\n\n{tables.paths_table(seeds)}"
        for renderer, seeds in found.items()
        if seeds
    ]
    return [report_text.PATHS, *parts, report_text.PATHS_REMARKS] if parts else []


def _building(results: Path) -> list[str]:
    runs = {
        f"{seed}, {RENDERER_NAMES[renderer]}": values
        for renderer in RENDERERS
        for seed, values in sorted(measured(results, "building", "building", renderer).items())
    }
    if not runs:
        return []
    return [report_text.BUILDING, tables.building_table(runs), report_text.BUILDING_REMARKS]


def _provenance(results: Path) -> str:
    """Return when and where the figures were measured."""
    files = [json.loads(path.read_text()) for path in sorted((results / "data").glob("*.json"))]
    places = sorted({f"{file['date']}: {file['machine']}, {file['size']} px" for file in files})
    return "Measured on " + "; ".join(places) + ". The numbers of each log are in `data/`.\n"
