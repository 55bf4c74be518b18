"""Bases that drive on tampered images, in lock-step: `python -m tests.bench.faults images --only half --images 3`.

An operator holds the stick ahead at 0.5 m/s in a corridor with a box, or with a person who steps in, and the images
are tampered with on the way. What counts: contacts of the robot's true outline, and the time from the fault (or from
the first motion after it) until the base slows down or stops for it, or the status names it.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.frame import Camera, Frame
from omnid.config import load_config
from omnid.core.control.collision_monitor import SCAN_STALE, UNOBSERVED, UNSEEN
from omnid.simulation.robot import make_robot
from tests.bench.obstacles import ahead
from tests.bench.results import ResultTable, columns
from tests.simulation.disturbed import Fault, Tamper, least_clearance_m, simulate
from tests.simulation.hazard_worlds import trial
from tests.simulation.lockstep import Moment, Request

Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]

SIZE_PX: Final = 384
SECONDS: Final = 7.5
STARTS_S: Final = 2.5  # of most faults: the base drives, and what stands in its way is some 1.5 m away
SECTOR_DEG: Final = 50.0
DIRT_PX: Final = 4.5  # sigma of the blur of a drop, at 384 px
REST_MPS: Final = 0.01


def sector(size_px: int, middle_deg: float, width_deg: float) -> Flags:
    """Return the pixels (H, W) of a simulated image about an azimuth of the base: forward is up, left is left."""
    middle = (size_px - 1) / 2
    x, y = np.meshgrid(np.arange(size_px) - middle, np.arange(size_px) - middle)
    azimuth = np.degrees(np.arctan2(-x, -y))
    return np.asarray(np.abs((azimuth - middle_deg + 180.0) % 360.0 - 180.0) <= width_deg / 2)


@dataclass(slots=True)
class Frozen:
    """A part of the images of one camera, or of both, that stays as it was."""

    part: Flags
    cameras: tuple[Camera, ...] = ("lower", "upper")
    starts_s: float = STARTS_S
    _kept: dict[Camera, Image] = field(default_factory=dict)

    def __call__(self, time_s: float, frame: Frame) -> Frame:
        """Return the frame with the part of the first one."""
        if frame.camera not in self.cameras or time_s < self.starts_s:
            return frame
        image = pixels(frame)
        kept = self._kept.setdefault(frame.camera, image)
        return replace(frame, data=np.where(self.part, kept, image))


@dataclass(slots=True)
class Late:
    """Images that show what was `late_s` before their stamps, or that play at a share of the speed from STARTS_S on."""

    late_s: float = 0.0
    speed: float = 1.0
    _before: dict[Camera, deque[tuple[float, Frame]]] = field(default_factory=dict)

    def __call__(self, time_s: float, frame: Frame) -> Frame:
        """Return the frame with the pixels of an earlier one; noise is added again, as by a sensor."""
        before = self._before.setdefault(frame.camera, deque())
        before.append((time_s, frame))
        slow_s = (1.0 - self.speed) * max(0.0, time_s - STARTS_S)
        shown_s = time_s - self.late_s - slow_s
        shown = min(before, key=lambda entry: abs(entry[0] - shown_s))[1]
        noise = np.random.default_rng(frame.seq).integers(-1, 2, pixels(shown).shape)
        image = np.clip(pixels(shown).astype(np.int16) + noise, 0, 255).astype(np.uint8)
        return frame if shown is frame else replace(frame, data=image)


def repeated(time_s: float, frame: Frame, kept: dict[Camera, Image]) -> Frame:
    """Return each second frame with the pixels of the one before."""
    if frame.seq % 2 == 0 or frame.camera not in kept or time_s < STARTS_S:
        kept[frame.camera] = pixels(frame)
        return frame
    return replace(frame, data=kept[frame.camera])


def blurred(time_s: float, frame: Frame, part: Flags) -> Frame:
    """Return the frame of the lower camera with a blurred part; the sensor's noise stays."""
    if frame.camera != "lower" or time_s < STARTS_S:
        return frame
    image = pixels(frame)
    noise = np.random.default_rng(frame.seq).normal(0.0, 1.5, image.shape)
    smooth = np.clip(np.rint(cv2.GaussianBlur(image, (0, 0), DIRT_PX) + noise), 0, 255).astype(np.uint8)
    return replace(frame, data=np.where(part, smooth, image))


def pixels(frame: Frame) -> Image:
    """Return the pixels (H, W) of a grey frame."""
    return np.asarray(frame.data, np.uint8).reshape(frame.height, frame.width)


class Case(NamedTuple):
    """A fault of the images, and the world in which it happens."""

    world: str  # its name
    tamper: Callable[[], Tamper | None]
    faults: tuple[Fault, ...] = ()
    since_s: float = STARTS_S  # of the fault


def _repeating() -> Tamper:
    kept: dict[Camera, Image] = {}
    return lambda time_s, frame: repeated(time_s, frame, kept)


CASES: Final[dict[str, Case]] = {
    "half frozen": Case("box", lambda: Frozen(sector(SIZE_PX, 0.0, 180.0))),
    "half frozen, one camera": Case("box", lambda: Frozen(sector(SIZE_PX, 0.0, 180.0), ("upper",))),
    "quarter frozen": Case("box", lambda: Frozen(sector(SIZE_PX, 0.0, 90.0))),
    "sector frozen": Case("box", lambda: Frozen(sector(SIZE_PX, 0.0, SECTOR_DEG))),
    "sector blurred": Case(
        "box", lambda: lambda time_s, frame: blurred(time_s, frame, sector(SIZE_PX, 0.0, SECTOR_DEG))
    ),
    "dark, a person steps in": Case("person_steps_in_at_80cm", lambda: None, (Fault("dark", STARTS_S, SECONDS),)),
    "late by 0.5 s": Case("box", lambda: Late(0.5), since_s=0.0),
    "late by 1 s": Case("box", lambda: Late(1.0), since_s=0.0),
    "half speed": Case("box", lambda: Late(speed=0.5)),
    "each second image repeated": Case("box", _repeating),
    "none": Case("box", lambda: None, since_s=0.0),
}


class Outcome(NamedTuple):
    """Outcome of a run."""

    contact_mps: float  # speed at the first contact; NaN: there was none
    clearance_m: float
    named_s: float  # from the fault, or from the first motion after it; NaN: it was not named
    text: str
    rest_s: float  # from the fault to wheels at rest; NaN: they never were


def run(name: str, seed: int, overrides: tuple[str, ...] = ()) -> Outcome:
    """Drive one seed of a case."""
    case = CASES[name]
    moving_s, first = math.inf, (math.nan, "")

    def watched(moment: Moment) -> Iterator[Request]:
        nonlocal moving_s, first
        state = moment.controller
        if not state.reason:
            moving_s = min(moving_s, max(moment.time_s, case.since_s))
        if moment.time_s >= moving_s and not first[1]:
            first = (moment.time_s, named(moment))
        yield from ahead(moment)

    done = simulate(
        trial(case.world, seed).world,
        replace(make_robot(SIZE_PX), samples=1),
        watched,
        seconds=SECONDS,
        seed=seed,
        faults=case.faults,
        tamper=case.tamper(),
        config=load_config(None, ["places.enabled=false", *overrides]),
    )
    ticks = done.ticks
    steps = list(pairwise(ticks))
    speeds = {two.time_s: math.dist(one.pose[:2], two.pose[:2]) / (two.time_s - one.time_s) for one, two in steps}
    contact_mps = speeds[done.contacts[0].time_s] if done.contacts else math.nan
    rest_s = next((at_s for at_s, speed in speeds.items() if at_s > moving_s and speed < REST_MPS), math.nan)
    began_s = max(case.since_s, moving_s)
    return Outcome(
        contact_mps, least_clearance_m(done), first[0] - began_s if first[1] else math.nan, first[1], rest_s - began_s
    )


def named(moment: Moment) -> str:
    """Return how the daemon names the fault now; empty: it does not. That an obstacle is near names no fault."""
    odometry, state = moment.odometry, moment.controller
    if state.obstacle in (UNOBSERVED, UNSEEN, SCAN_STALE):
        return state.obstacle
    if odometry is not None and odometry.depth.panoramas.tiles.unknown.any():
        return "the status names the part"
    return state.slowed_by or ("" if state.armed else state.disarmed_by)


def run_all(words: Sequence[str], count: int, seed: int) -> int:
    """Print and save a row for each case whose name has one of the words; return the cases with a contact.

    Repeated images are left out, and `none` is no fault: these need not be named.
    """
    head = columns(
        *("images", "runs", "contacts", "fastest contact|m/s|2", "least clearance|m|2", "named"),
        *("named after, longest|s|2", "at rest after, longest|s|2", "as"),
    )
    remark = f"{SIZE_PX} px, 10 Hz, operator ahead at 0.5 m/s, {SECONDS:g} s"
    table = ResultTable("faults_images", "Tampered images, in lock-step", head, (remark,))
    failed = 0
    for name in (name for name in CASES if not words or any(word in name for word in words)):
        used = [("tampered images", number) for number in range(seed, seed + count)]
        table.seeds += [each for each in used if each not in table.seeds]
        outcomes = [run(name, number) for _, number in used]
        hits = [outcome.contact_mps for outcome in outcomes if math.isfinite(outcome.contact_mps)]
        times = [outcome.named_s for outcome in outcomes if outcome.text]
        rests = [outcome.rest_s for outcome in outcomes if math.isfinite(outcome.rest_s)]
        texts = Counter(outcome.text for outcome in outcomes if outcome.text)
        table.add(
            name,
            count,
            len(hits),
            max(hits, default=None),
            min(outcome.clearance_m for outcome in outcomes),
            len(times),
            max(times, default=None),
            max(rests, default=None),
            "; ".join(texts),
        )
        failed += bool(hits)
    return failed
