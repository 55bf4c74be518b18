"""Maps of places of a run: read at its start, saved now and then, and at its end."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from stat import S_ISREG
from typing import Final

from calib.rig import MountedCamera
from calib.rig_file import rig_toml
from omnid.config import Config, PlacesConfig
from omnid.core.places.place_map import PlaceMap, PlaceRig
from omnid.engine.graph import Stream
from omnid.engine.logging_setup import log
from omnid.errors import OmnidError
from omnid.formats.place_file import read_places, write_places
from omnid.messages import MapCopy, PlaceUpdate, SaveMap
from omnid.runs.wiring import Parts
from omnid.sinks.files import check_outputs
from omnid.stages.geometry import Geometry
from omnid.transport.codec import string_from_cdr
from omnid.transport.topics import SAVE_MAP, Answer, Request


@dataclass(frozen=True, slots=True, eq=False)
class RigPlaces:
    """A map of places and the rig that saw them."""

    places: PlaceMap
    rig: PlaceRig


class RunPlaces:
    """Holds the map that a run localises in; `places` is None where the run has no map but its own."""

    def __init__(
        self,
        config: Config,
        geometry: Geometry,
        warn: Callable[[str], None],
        given: RigPlaces | None = None,
        *,
        build: bool = False,
    ) -> None:
        """given: a map in the memory, in the place of the file places.map; build: or else an empty one.

        warn: takes a line for the user.

        A file that does not exist is made by this run, unless it only localises.
        Raises OmnidError for a file that is no map, or that of another rig.
        """
        settings, self._warn, self._rig = config.places, warn, place_rig(geometry)
        if settings.map and not settings.enabled:
            raise OmnidError("places.map (--map) needs places.enabled = true: leave one of them out")
        if settings.localize_only and not settings.map:
            raise OmnidError("places.localize_only (--localize-only) needs a map: add --map FILE.omap, or leave it out")
        # 1. The map: that which was given, that of the file, a new one, or none.
        self._path = Path(settings.map) if settings.map and given is None and not build else None
        self.is_extended = self._path is not None and not settings.localize_only  # this run writes the file
        self._version = None if self._path is None else _version(self._path)
        self.written: Path | None = None  # the file, once the run has written it
        if self._path is not None:
            if self.is_extended:
                check_outputs([("--map", self._path)], [])
            if self.is_extended and not self._path.exists():
                log(logging.INFO, f"{self._path}: there is no such map: this run begins a new one")
            else:
                given = RigPlaces(*read_places(self._path, new_places(settings)))
        self.places: PlaceMap | None = None
        if given is not None or build or self._path is not None:
            self.places = new_places(settings) if given is None else given.places
        self._saved = frozenset[int]()  # keyframes in the file
        self._asks = False  # whether the place is another one
        self._known = frozenset(given.places.keyframes) if given else frozenset[int]()
        # 2. It must fit the rig, and is adapted to the panoramas of this run.
        if given is not None and self._known:
            name = self._path or "the map"
            if difference := given.rig.difference(self._rig):
                raise OmnidError(
                    f"{name}: this map was made with {difference}: build one with this rig, by `omnid map build`"
                )
            if given.rig.rig_hash != self._rig.rig_hash:
                warn(f"{name}: the rig was calibrated again since this map was made")
            self._rig.adapt(given.places, given.rig)

    def known_to(self, parts: Parts) -> Parts:
        """Return the parts of the run with this map, if there is one."""
        if self.places is None:
            return parts
        return replace(parts, known_places=self.places, localize_only=self._path is not None and not self.is_extended)

    def save(self, places: PlaceMap) -> bool:
        """Write the joined part of a copy of the map; return False if the part has nothing new.

        Raises OmnidError if the file cannot be written.
        """
        joined = self._joined(places)
        if self._known and not joined - self._known and places.keyframes.keys() - self._known and not self._asks:
            self._asks = True
            self._warn(f"{self._path}: no place of it is recognised so far: is this another place? Name another map")
        if self._path is None or not joined - self._known or joined == self._saved:
            return False
        self._write(self._path, places.part(joined))
        self._saved = joined
        return True

    def _write(self, path: Path, places: PlaceMap) -> None:
        """Write the map to its file, or to one next to it where another program has written that file meanwhile."""
        if _version(path) not in (None, self._version):
            other = _beside(path)
            self._warn(
                f"{path}: another program has written this map since this run read it: the map of this run is {other}"
            )
            path = other
        write_places(path, places, self._rig)
        self._path = self.written = path
        self._version = _version(path)

    def finish(self) -> RigPlaces | None:
        """Return the joined part of the map after the run, and write it to its file if it was extended.

        Raises OmnidError if the file cannot be written.
        """
        if self.places is None:
            return None
        joined = self._joined(self.places)
        new = len(joined - self._known)
        unjoined = len(self.places.keyframes.keys() - joined - self._known)
        self.places = self.places.part(joined)
        found = RigPlaces(self.places, self._rig)
        name = self._path or "the map"
        if self._known and not new and unjoined:
            self._warn(f"{name}: no place of it was recognised: nothing was added to it")
        elif unjoined:
            self._warn(f"{name}: {unjoined} keyframes after a gap were recognised nowhere: they were left out")
        if self._path is not None and self.is_extended and new:
            self._write(self._path, self.places)
        elif self._path is not None and self.is_extended and not self._known:
            self._warn(f"{self._path}: no keyframe was found: no map was written")
        return found

    def _joined(self, places: PlaceMap) -> frozenset[int]:
        """Return the keyframes that links join to the map that was given, or else the largest part."""
        if not places.keyframes:
            return frozenset()
        found = places.parts()
        return frozenset(next((part for part in found if self._known.intersection(part)), found[0]))


def _version(path: Path) -> tuple[int, int] | None:
    """Return what changes where a file is written again; None: there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return (found.st_ino, found.st_mtime_ns) if S_ISREG(found.st_mode) else None


def _beside(path: Path) -> Path:
    """Return the first free name next to a file."""
    return next(name for number in count(2) if not (name := path.with_stem(f"{path.stem}-{number}")).exists())


def place_rig(geometry: Geometry) -> PlaceRig:
    """Return the part of a rig on which a map depends."""
    rig = geometry.rig
    text = rig_toml(replace(rig, lower=_unmasked(rig.lower), upper=_unmasked(rig.upper), covariance=None))
    return PlaceRig(
        geometry.cylinder.full_turn,
        rig.baseline_m,
        geometry.T_rig_rect,
        rig.T_base_rig,
        hashlib.sha256(text.encode()).hexdigest(),
    )


def new_places(settings: PlacesConfig) -> PlaceMap:
    """Return an empty map with the bounds of the settings."""
    return PlaceMap(settings.limits.max_keyframes)


def _unmasked(camera: MountedCamera) -> MountedCamera:
    """Return a camera without its mask, which may have been found in the images of the run."""
    return replace(camera, mask=None)


_LONGEST_REQUEST: Final = 64  # bytes


class MapSaver:
    """A sink that writes the copies of the map that come with poses, and answers the requests for them.

    So a robot that is switched off loses little of its map. Copying 1,000 keyframes takes the stage some 0.2 ms.
    """

    def __init__(
        self, run_places: RunPlaces, every_s: float, requests: Stream[SaveMap], answer: Callable[[int, Answer], object]
    ) -> None:
        """every_s: between two copies. requests: takes those of the bus. answer: takes the id of a request; a second
        call for it does nothing.
        """
        self.every_s, self.requests = every_s, requests
        self._run_places, self._answer = run_places, answer
        self._seen: MapCopy | None = None
        self._saves = self._failed = self._refused = 0
        self._error = ""  # of the last save; empty: it succeeded

    def process(self, update: PlaceUpdate) -> None:
        """Write the copy of the map, if it is a new one."""
        copy = update.copy
        if copy is not None and copy is not self._seen:
            self._seen = copy
            answer = self._save(copy.places)
            for id in copy.ids:
                self._answer(id, answer)

    def receive(self, request: Request) -> Answer | None:
        """Take a request from the bus, a String "save", from any thread; return the refusal of any other."""
        with suppress(OmnidError):
            if string_from_cdr(request.payload[:_LONGEST_REQUEST]) == SAVE_MAP:
                self.requests.push(SaveMap(request.id))
                return None
        self._refused += 1
        return Answer(False, f'a String "{SAVE_MAP}" was expected')

    def _save(self, copy: PlaceMap) -> Answer:
        try:
            is_new = self._run_places.save(copy)
        except OmnidError as error:
            self._failed += 1
            self._error = str(error)
            return Answer(False, f"the map is not saved: {error}")
        self._saves += is_new
        self._error = ""
        return Answer(True, "the map is saved" if is_new else "the map in the file has all that is known already")

    def stats(self) -> dict[str, object]:
        """Return how often the map was saved, and why it is not."""
        return {"saves": self._saves, "failed": self._failed, "refused": self._refused, "_error": self._error}
