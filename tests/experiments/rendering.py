"""Render a run as a log with its truth: by POV-Ray, image by image and resumable, or by the ray caster."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from omnid.simulation.rendering.sensor import Floats
from tests.experiments.povray import shoot, write_world
from tests.simulation.logs import pack_log, write_log
from tests.simulation.recipes import SimulatedRun

CAMERAS = ("lower", "upper")


def render_log(folder: Path, run: SimulatedRun, seed: int, *, supersample: int = 2, jobs: int = 2) -> None:
    """Render the missing images in folder/frames and write log.mcap, truth.txt, rig.toml and camchain.yaml beside it.

    Does nothing if the log exists. An image file is always complete, so the same command continues an interrupted
    run. The images are removed once they are packed.
    """
    if (folder / "log.mcap").exists():
        return
    frames = folder / "frames"
    frames.mkdir(parents=True, exist_ok=True)
    write_world(folder / "world", run.scene)
    wanted = [(pair, camera) for pair in range(len(run.poses)) for camera in (0, 1)]
    missing = [w for w in wanted if not _path(frames, *w).exists()]

    def draw(image: tuple[int, int]) -> None:
        mounted = (run.rig.lower, run.rig.upper)[image[1]]
        _save(_path(frames, *image), shoot(folder / "world", mounted, run.poses[image[0]], supersample))

    with ThreadPoolExecutor(jobs) as pool:
        _watch(pool.map(draw, missing), len(missing), folder.name)
    pack_log(
        folder,
        run.rig,
        run.poses,
        lambda pair, camera: _load(_path(frames, pair, camera)),
        sensor=run.sensor,
        seed=seed,
    )
    _remove(frames, folder / "world")


def cast_log(folder: Path, run: SimulatedRun, seed: int, *, supersample: int = 2) -> None:
    """Render a run by the ray caster of tests/simulation and write the same files; does nothing if the log exists."""
    if not (folder / "log.mcap").exists():
        write_log(
            folder,
            run.rig,
            run.poses,
            run.scene,
            sensor=run.sensor,
            seed=seed,
            supersample=supersample,
            progress=partial(_show_progress, folder.name, time.monotonic()),
        )


def _path(frames: Path, pair: int, camera: int) -> Path:
    return frames / f"{pair:04d}_{CAMERAS[camera]}.png"


def _save(path: Path, image: Floats) -> None:
    """Save an image with 16 bits, so that the sensor's noise is added before rounding; complete or not at all."""
    part = path.with_suffix(".part.png")
    cv2.imwrite(str(part), np.rint(image * 257).astype(np.uint16))
    part.replace(path)


def _load(path: Path) -> Floats:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, f"{path} cannot be read: delete it and render again"
    return np.asarray(image / np.float32(257), np.float32)


def _watch(done: Iterable[None], total: int, name: str) -> None:
    """Show the progress on stderr."""
    started_s = time.monotonic()
    for count, _ in enumerate(done, 1):
        _show_progress(name, started_s, count, total)


def _show_progress(name: str, started_s: float, count: int, total: int) -> None:
    left_s = (time.monotonic() - started_s) / count * (total - count)
    sys.stderr.write(f"\r{name}: {count}/{total}, {left_s:.0f} s left   " + ("\n" if count == total else ""))


def _remove(*folders: Path) -> None:
    for folder in folders:
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()
