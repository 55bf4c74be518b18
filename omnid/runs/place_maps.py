"""The map of places of a run: read at its start, saved now and then by a daemon, and at the end."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from stat import S_ISREG

from calib.rig_file import rig_toml
from omnid.config import Config
from omnid.core.places.place_map import PlaceMap, PlaceRig
from omnid.engine.graph import Stream, nothing
from omnid.engine.logging_setup import log
from omnid.errors import OmnidError
from omnid.formats.place_file import read_places, write_places
from omnid.messages import MapCopy, PlaceUpdate, SaveMap
from omnid.sinks.files import check_outputs
from omnid.stages.geometry import Geometry
from omnid.transport.topics import Answer


class RunPlaces:
    """Holds the map that a run localises in; `places` is None where the run has no map but its own.

    A sink of poses in the map that writes the copies of the map that they carry, so that a robot that is switched off
    loses little of it.
    """

    def __init__(self, config: Config, geometry: Geometry, warn: Callable[[str], None]) -> None:
        """Read the file places.map. One that does not exist is made by this run, unless it only localises.

        warn: takes a line for the user. Raises OmnidError for a file that is no map, or that of another rig.
        """
        settings, self._warn, self._rig = config.places, warn, place_rig(geometry)
        if settings.map and not settings.enabled:
            raise OmnidError("places.map (--map) needs places.enabled = true: leave one of them out")
        if settings.localize_only and not settings.map:
            raise OmnidError("places.localize_only (--localize-only) needs a map: add --map FILE.omap, or leave it out")
        # 1. The map: that of the file, a new one, or none.
        path = self._path = Path(settings.map)
        self.localize_only = settings.localize_only
        self.is_extended = bool(settings.map) and not settings.localize_only  # the file is written
        self._version = _version(path)
        self.places = PlaceMap(settings.limits.max_keyframes) if settings.map else None
        if self.is_extended:
            check_outputs([("--map", path)], [])
        if self.is_extended and not path.exists():
            log(logging.INFO, f"{path.name}: there is no such map: this run begins a new one")
        elif self.places is not None:
            self.places, rig = read_places(path, self.places)
            # 2. It must fit the rig, and is adapted to the panoramas of this run.
            if difference := rig.difference(self._rig):
                raise OmnidError(
                    f"{path}: this map was made with {difference}: build one with this rig, by `omnid map build`"
                )
            if rig.rig_hash != self._rig.rig_hash:
                warn(f"{path}: the rig was calibrated again since this map was made")
            self._rig.adapt(self.places, rig)
        self._known = frozenset(self.places.keyframes if self.places else ())
        # 3. What was saved, and requests for it.
        self.copy_s = 0.0  # time between two copies that are saved; 0: none is
        self.requests: Stream[SaveMap] | None = None
        self.written: Path | None = None  # the file, once the run has written it
        self._answer: Callable[[int, Answer], object] = nothing
        self._saved = frozenset[int]()  # keyframes in the file
        self._seen: MapCopy | None = None
        self._was_elsewhere = False  # whether the user was asked if the place is another one
        self._counts = {"saves": 0, "failed": 0}
        self._error = ""  # of the last save; empty: it succeeded

    def save_now_and_then(
        self, every_s: float, requests: Stream[SaveMap], answer: Callable[[int, Answer], object]
    ) -> None:
        """Save the map each every_s, and where it is asked for. requests: takes those of the bus.

        answer: takes the id of a request; a second call for it does nothing.
        """
        self.copy_s, self.requests, self._answer = every_s, requests, answer

    def process(self, update: PlaceUpdate) -> None:
        """Write the copy of the map that comes with a pose, if it is a new one."""
        copy = update.copy
        if copy is None or copy is self._seen:
            return
        self._seen = copy
        joined = self._joined(copy.places)
        new = joined - self._known
        if self._known and not new and len(copy.places.keyframes) > len(self._known) and not self._was_elsewhere:
            self._was_elsewhere = True
            self._warn(f"{self._path}: no place of it is recognised so far: is this another place? Name another map")
        answer, self._error = Answer(True, "the map in the file has all that is known already"), ""
        if new and joined != self._saved:
            try:
                self._write(copy.places.part(joined))
                self._saved, answer = joined, Answer(True, "the map is saved")
                self._counts["saves"] += 1
            except OmnidError as error:
                self._counts["failed"] += 1
                self._error, answer = str(error), Answer(False, f"the map is not saved: {error}")
        for id in copy.ids:
            self._answer(id, answer)

    def stats(self) -> dict[str, object]:
        """Return how often the map was saved, and why it is not."""
        return {**self._counts, "_error": self._error, "_words": "saves the map"}

    def finish_run(self) -> None:
        """Write the joined part of the map to its file after the run, if it was extended.

        Raises OmnidError if the file cannot be written.
        """
        if self.places is None:
            return
        joined = self._joined(self.places)
        new, unjoined = len(joined - self._known), len(self.places.keyframes.keys() - joined - self._known)
        if self._known and not new and unjoined:
            self._warn(f"{self._path}: no place of it was recognised: nothing was added to it")
        elif unjoined:
            self._warn(f"{self._path}: {unjoined} keyframes after a gap were recognised nowhere: they were left out")
        if self.is_extended and new:
            self._write(self.places.part(joined))
        elif self.is_extended and not self._known:
            self._warn(f"{self._path}: no keyframe was found: no map was written")

    def _write(self, places: PlaceMap) -> None:
        """Write the map to its file, or to one next to it where another program has written that file meanwhile."""
        path = self._path
        if _version(path) not in (None, self._version):
            names = (path.with_stem(f"{path.stem}-{number}") for number in count(2))
            other = next(name for name in names if not name.exists())
            self._warn(
                f"{path}: another program has written this map since this run read it: the map of this run is {other}"
            )
            path = other
        write_places(path, places, self._rig)
        self._path, self.written, self._version = path, path, _version(path)

    def _joined(self, places: PlaceMap) -> frozenset[int]:
        """Return the keyframes that links join to the map that was given, or else the largest part."""
        found = places.parts() or [[]]
        return frozenset(next((part for part in found if self._known.intersection(part)), found[0]))


def _version(path: Path) -> tuple[int, int] | None:
    """Return what changes where a file is written again; None: there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return (found.st_ino, found.st_mtime_ns) if S_ISREG(found.st_mode) else None


def place_rig(geometry: Geometry) -> PlaceRig:
    """Return the part of a rig on which a map depends; its masks may have been found in the images of the run."""
    rig = geometry.rig
    lower, upper = (replace(camera, mask=None) for camera in (rig.lower, rig.upper))
    text = rig_toml(replace(rig, lower=lower, upper=upper, covariance=None))
    return PlaceRig(
        geometry.cylinder.full_turn,
        rig.baseline_m,
        geometry.T_rig_rect,
        rig.T_base_rig,
        hashlib.sha256(text.encode()).hexdigest(),
    )
