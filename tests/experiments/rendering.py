"""Renders a run image by image, goes on where it stopped, and packs the images as a log with its truth."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from tests.experiments.povray import shoot, write_world
from tests.simulation.logs import pack_log
from tests.simulation.recipes import Run
from tests.simulation.sensor import Floats

CAMERAS = ("lower", "upper")


def render_log(folder: Path, run: Run, seed: int, *, supersample: int = 2, jobs: int = 2) -> None:
    """Renders what is missing in folder/frames and writes log.mcap, truth.txt, rig.toml and camchain.yaml beside it.

    Does nothing where the log stands already. A image that is there is whole: another run of the same command goes
    on where this one stopped. The frames are removed once they are packed.
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
    pack_log(folder, run.rig, run.poses, lambda pair, camera: _load(_path(frames, pair, camera)), sensor=run.sensor,
             seed=seed)
    _remove(frames, folder / "world")


def _path(frames: Path, pair: int, camera: int) -> Path:
    return frames / f"{pair:04d}_{CAMERAS[camera]}.png"


def _save(path: Path, image: Floats) -> None:
    """Sixteen bits, so that shrinking is not rounded away before the sensor's noise; whole or not at all."""
    part = path.with_suffix(".part.png")
    cv2.imwrite(str(part), np.rint(image * 257).astype(np.uint16))
    part.replace(path)


def _load(path: Path) -> Floats:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, f"{path} cannot be read: delete it and render again"
    return np.asarray(image / np.float32(257), np.float32)


def _watch(done: Iterable[None], total: int, name: str) -> None:
    """Shows how far it is."""
    started = time.monotonic()
    for count, _ in enumerate(done, 1):
        left_s = (time.monotonic() - started) / count * (total - count)
        sys.stderr.write(f"\r{name}: {count}/{total} images, {left_s:.0f} s left   ")
    sys.stderr.write("\n" if total else "")


def _remove(*folders: Path) -> None:
    for folder in folders:
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()
