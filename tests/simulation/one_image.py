"""One camera whose images hold both views of a rig: two mirrors on one axis, a log and images of boards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from calib.boards.board import Board
from calib.boards.print_shape import AS_DRAWN
from calib.models.camera import Array, Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from calib.rig_file import write_rig
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.rigs import RIM, make_rig
from omnid.simulation.rendering.sensor import Floats, MountedSensor, Sensor
from omnid.simulation.rendering.surfaces import Scene
from tests.drivers.logs.mcap_logs import COMPRESSED, Entry, compressed
from tests.drivers.logs.mcap_logs import write_log as write_mcap
from tests.simulation.boards import board_texture, clutter, print_rectangles
from tests.simulation.logs import START_NS, tum
from tests.simulation.readout import Readout

TOPIC: Final = "/camera/image/compressed"
# The lower mirror's part of the image's width, where its circle is [px], and the width of the edge between the views.
INNER, SHIFT_PX, EDGE_PX = 0.4, (3.0, -2.0), 2.0


def coaxial_rig(size: int, misaligned_deg: tuple[float, float, float] = (0.5, -0.4, 0.6)) -> Rig:
    """Return a rig whose lower mirror is a disc in the middle of the image, and the upper one the ring around it."""
    small, large = (make_rig(size=part, misaligned_deg=misaligned_deg) for part in (round(INNER * size), size))
    camera, radius_px = small.lower.camera, RIM * small.lower.camera.size[0]
    assert isinstance(camera, UnifiedCamera)
    u, v = (c + (size - camera.size[0]) / 2 + s for c, s in zip(camera.center, SHIFT_PX, strict=True))
    lower = replace(small.lower, camera=replace(camera, center=(u, v), size=(size, size)))
    x, y = np.meshgrid(np.arange(size) - u, np.arange(size) - v)
    ring = np.where(np.hypot(x, y) > radius_px + EDGE_PX, 255, 0).astype(np.uint8)
    upper = replace(large.upper, mask=replace(large.upper.visible, image=ring))
    return Rig(replace(lower, mask=Mask((u, v), 0.0, radius_px)), upper, topics=(TOPIC, TOPIC))


def areas(rig: Rig) -> tuple[str, str]:
    """Return the rectangles about the discs of both views as `calibrate rig` takes them, to a pixel."""
    return _area(rig.lower), _area(rig.upper)


def _area(mounted: MountedCamera) -> str:
    mask, (width, height) = mounted.visible, mounted.camera.size
    left, top = (max(0, round(c - mask.outer_px)) for c in mask.center)
    right, bottom = (
        min(side, round(c + mask.outer_px) + 1) for c, side in zip(mask.center, (width, height), strict=True)
    )
    return f"{left},{top},{right - left},{bottom - top}"


def render_both(scene: Scene, rig: Rig, T_world_rig: Array) -> Floats:
    """Return the ideal image (H, W) of both views, each inside its mask."""
    lower, upper = (render_grey(scene, mounted, T_world_rig) for mounted in (rig.lower, rig.upper))
    return lower + upper


def write_log(folder: Path, rig: Rig, poses: Array, scene: Scene, seed: int = 0) -> None:
    """Render images at poses T_world_rig (N, 4, 4), and write log.mcap with one topic, rig.toml and truth.txt."""
    folder.mkdir(parents=True, exist_ok=True)
    sensor, rng = _sensor(rig, Sensor()), np.random.default_rng([seed, 6])
    stamps = START_NS + Readout().period_ns * np.arange(len(poses), dtype=np.int64)
    entries = []
    for stamp, T in zip(stamps.tolist(), poses, strict=True):
        image = sensor.jpeg(sensor.expose(render_both(scene, rig, T), rng))
        entries.append(Entry(rig.topics[0], COMPRESSED, compressed(stamp, image), stamp))
    write_mcap(folder / "log.mcap", entries)
    (folder / "truth.txt").write_text(tum(stamps, poses))
    write_rig(folder / "rig.toml", rig)


def write_boards(folder: Path, rig: Rig, board: Board, poses: Sequence[Array], noise: float, seed: int = 0) -> None:
    """Render images of a board at poses T_rig_board (4, 4) among walls, and write them as 00.jpg, 01.jpg ..."""
    folder.mkdir(parents=True, exist_ok=True)
    sensor = _sensor(rig, Sensor(noise_sigma=noise))
    for number, T in enumerate(poses):
        rng = np.random.default_rng([seed, number])
        scene = Scene((*print_rectangles(board, AS_DRAWN, T, board_texture(board)), *clutter(rng)))
        image = sensor.jpeg(sensor.expose(render_both(scene, rig, np.eye(4)), rng))
        (folder / f"{number:02d}.jpg").write_bytes(image)


def _sensor(rig: Rig, sensor: Sensor) -> MountedSensor:
    """Return the exposure of the one sensor, without a vignette or a hub."""
    return MountedSensor.of(sensor, Mask(rig.lower.camera.center), rig.lower.camera.size)
