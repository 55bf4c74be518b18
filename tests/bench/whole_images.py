"""Images that are whole, but torn, displaced or with lines missing: `python -m tests.bench.whole_images --seeds 3 601`.

Each row is a replay of a rendered drive whose images were edited from a third of it on, or all of them: the line, how
often, and the size are drawn from the seed. Sure but wrong: poses that are `tracking` and off by more than three of
their sigmas (the largest of the position) and 5 mm. --log adds drives: NAME=FOLDER with log.mcap, rig.toml, truth.txt.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, NamedTuple

import numpy as np

from calib import se3
from calib.rig_file import read_rig
from drivers.frame import CAMERAS, Camera, Frame, gray
from drivers.logs.log_reader import LogReader
from omnid.config import load_config
from omnid.errors import OmnidError
from omnid.formats.tum import read_tum
from omnid.messages import FramePair
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry, with_rims
from tests.bench.results import Column, ResultTable
from tests.simulation import build, write_log
from tests.simulation.whole_images import Image, repeat_lines, shift, tear, turn

Edit = Callable[[Sequence[Image], random.Random], list[Image]]
SIZE, PAIRS = 384, 36
SCENES: Final = ("two_walls", "rooms", "back", "fast")  # even, turning, standing first, fast
PLACES: Final[dict[str, tuple[Camera, ...]]] = {"lower": ("lower",), "upper": ("upper",), "both": CAMERAS}
SIGMAS, LEAST_M = 3.0, 0.005


def _line(images: Sequence[Image], rng: random.Random, axis: int) -> int:
    return round(rng.uniform(0.25, 0.75) * images[0].shape[axis])


def _torn(every: int, axis: int = 0, since: float = 1 / 3) -> Edit:
    def edit(images: Sequence[Image], rng: random.Random) -> list[Image]:
        new_below = rng.random() < 0.5
        line, first = _line(images, rng, axis), max(1, round(since * len(images)))
        return tear(images, line, every=every, axis=axis, new_below=new_below, since=first)

    return edit


def _torn_anywhere(images: Sequence[Image], rng: random.Random) -> list[Image]:
    lines = [_line(images, rng, 0) for _ in images]
    return tear(images, lambda number: lines[number], since=len(images) // 3)


def _displaced(least_px: float, most_px: float) -> Edit:
    def edit(images: Sequence[Image], rng: random.Random) -> list[Image]:
        length, angle = rng.uniform(least_px, most_px), rng.uniform(0, 2 * math.pi)
        by_px = round(length * math.cos(angle)), round(length * math.sin(angle))
        return shift(images, by_px, since=len(images) // 3)

    return edit


def _lines(images: Sequence[Image], rng: random.Random) -> list[Image]:
    axis, count = rng.randrange(2), rng.choice((-8, -4, -2, 2, 4, 8))
    return repeat_lines(images, _line(images, rng, axis), count, axis=axis, since=len(images) // 3)


def _turned(images: Sequence[Image], rng: random.Random) -> list[Image]:
    return turn(images, rng.choice((-1, 1)) * rng.uniform(0.3, 3.0), since=len(images) // 3)


KINDS: Final[dict[str, Edit | None]] = {
    "whole": None,
    "torn": _torn(1),
    "torn from the first": _torn(1, since=0.0),
    "torn, every 3rd": _torn(3),
    "torn, every 10th": _torn(10),
    "torn at a column": _torn(1, axis=1),
    "torn anywhere": _torn_anywhere,
    "displaced 1 to 3 px": _displaced(1.5, 3.0),
    "displaced 4 to 20 px": _displaced(4.0, 20.0),
    "lines twice or missing": _lines,
    "turned": _turned,
}


class Drive(NamedTuple):
    """A drive, with the images of each camera."""

    name: str
    folder: Path
    images: dict[Camera, list[Image]]
    stamps_ns: list[int]

    @staticmethod
    def read(name: str, folder: Path) -> Drive:
        """Read log.mcap in a folder."""
        rig = read_rig(folder / "rig.toml")
        reader = LogReader(folder / "log.mcap", *rig.topics)
        frames: dict[Camera, list[Frame]] = {camera: [] for camera in CAMERAS}
        for frame in reader.frames():
            frames[frame.camera].append(frame)
        reader.close()
        stamps_ns = [frame.stamp_ns for frame in frames["lower"]]
        return Drive(name, folder, {camera: [gray(f) for f in own] for camera, own in frames.items()}, stamps_ns)


class Outcome(NamedTuple):
    """Outcome of a replay."""

    error_m: float
    over_sigma: float  # of the poses that are `tracking`, the largest
    nees: float  # of those, the largest mean square over six components
    sure: float  # share of poses that are `tracking`
    wrong: float  # share of poses that are `tracking` and wrong
    named_s: float
    lines: list[str]


def replayed(drive: Drive, images: dict[Camera, list[Image]], since: int) -> Outcome:
    """Return the outcome of a drive with these images, which were edited from one on."""
    rig, config = read_rig(drive.folder / "rig.toml"), load_config(None, [])
    frames = [
        Frame(number, number, camera, "mono8", image, image.shape[1], image.shape[0])
        for camera in CAMERAS
        for number, image in enumerate(images[camera][:30])
    ]
    front_end = FrontEnd(geometry(with_rims(rig, frames), config.panorama), config)
    truth = read_tum(drive.folder / "truth.txt")
    T_true = se3.inverse(truth.T[0]) @ truth.T
    errors, ratios, nees, sure, named_s = [0.0], [0.0], [0.0], [], math.nan
    for number, stamp_ns in enumerate(drive.stamps_ns):
        pair = FramePair(number, stamp_ns, images["lower"][number], images["upper"][number])
        try:
            update = front_end.process(pair)
        except OmnidError:
            break
        front_end.poses.after()
        if update.image_fault and math.isnan(named_s):
            named_s = (stamp_ns - drive.stamps_ns[since]) * 1e-9
        is_sure = update.state == "tracking"
        xi = se3.log(se3.inverse(T_true[number]) @ update.T_odom_rig)
        error_m = float(np.linalg.norm(update.position - T_true[number][:3, 3]))
        sigma_m = math.sqrt(float(np.linalg.eigvalsh(update.covariance[:3, :3])[-1])) if number else math.inf
        errors.append(error_m)
        sure.append((is_sure, is_sure and error_m > max(LEAST_M, SIGMAS * sigma_m)))
        if is_sure and number:
            ratios.append(error_m / max(sigma_m, 1e-6))
            nees.append(float(xi @ np.linalg.solve(update.covariance, xi)) / 6)
    shares = np.array(sure).mean(axis=0)
    lines = front_end.odometry.image_faults
    return Outcome(max(errors), max(ratios), max(nees), float(shares[0]), float(shares[1]), named_s, lines)


def drives(folder: Path, seed: int, names: Sequence[str]) -> list[Drive]:
    """Return rendered drives."""
    found = []
    for name in names:
        run = build(name, seed, SIZE, PAIRS)
        write_log(folder / name, run.rig, run.poses[: PAIRS - 2], run.scene, sensor=run.sensor, seed=seed)
        found.append(Drive.read(name, folder / name))
    return found


def main() -> int:
    """Print the table; return 1 where a whole image was suspected, or a broken one was sure and wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.whole_images", description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3])
    parser.add_argument("--scenes", nargs="*", default=SCENES, choices=[*SCENES, []])
    parser.add_argument("--log", action="append", default=[], metavar="NAME=FOLDER")
    parser.add_argument("--only", action="append", default=[], metavar="WORD", help="kinds whose name has the word")
    args = parser.parse_args()
    columns = (
        Column("images"),
        Column("cameras"),
        Column("drive"),
        Column("seed"),
        Column("worst error", "mm", 1),
        Column("tracking", "%", 0),
        Column("error over sigma", "", 1),
        Column("NEES", "", 1),
        Column("sure but wrong", "%", 0),
        Column("named after", "s", 1),
        Column("as"),
    )
    table, failed = ResultTable("whole_images", "Torn and displaced images", columns), 0
    for seed in args.seeds:
        with TemporaryDirectory() as folder:
            found = drives(Path(folder), seed, args.scenes)
            found += [Drive.read(name, Path(path)) for name, path in (text.split("=") for text in args.log)]
            for kind, edit in KINDS.items():
                if args.only and not any(word in kind for word in args.only):
                    continue
                for drive in found:
                    failed += sum(_row(table, kind, edit, place, drive, seed) for place in PLACES)
    return int(failed > 0)


def _row(table: ResultTable, kind: str, edit: Edit | None, place: str, drive: Drive, seed: int) -> bool:
    """Add a row; return whether it failed."""
    if edit is None and place != "both":
        return False
    images = dict(drive.images)
    for camera in PLACES[place] if edit else ():
        assert edit is not None
        images[camera] = edit(images[camera], random.Random(f"{kind} {seed} {drive.name}"))
    since = 1 if "first" in kind else len(drive.stamps_ns) // 3
    done = replayed(drive, images, since)
    named_s = None if math.isnan(done.named_s) else done.named_s
    figures = (1e3 * done.error_m, 100 * done.sure, done.over_sigma, done.nees, 100 * done.wrong, named_s)
    table.add(kind, place, drive.name, seed, *figures, "; ".join(line.split(":")[0] for line in done.lines))
    return bool(done.lines) if edit is None else done.wrong > 0


if __name__ == "__main__":
    sys.exit(main())
