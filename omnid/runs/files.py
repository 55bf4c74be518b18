"""The map of places and the routes of a run: read at its start, and written.

Stages of the thread of the files write them and answer the requests to do so: no other thread waits for a disk.
"""

from __future__ import annotations

import hashlib
import logging
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from calib.rig_file import rig_toml
from omnid.config import Config
from omnid.core.nanoseconds import NS_PER_S
from omnid.core.navigation.requests import TaughtRoute
from omnid.core.navigation.route import Route
from omnid.core.places.place_map import PlaceMap, PlaceRig
from omnid.engine.graph import Stream
from omnid.engine.logging_setup import log
from omnid.errors import OmnidError
from omnid.formats.place_file import read_places, write_places
from omnid.formats.route_file import RouteFolder
from omnid.messages import NavigationUpdate, PlaceUpdate
from omnid.sinks.files import check_outputs
from omnid.stages.geometry import Geometry
from omnid.transport.topics import MAX_OPEN, Answer, Answers


class MapCopy(NamedTuple):
    """A copy of the map, to be written."""

    places: PlaceMap
    request_ids: tuple[int, ...]  # of the requests that it answers


class RunPlaces:
    """Holds the map that a run localises in; `places` is None where the run has no map but its own.

    While the run goes on the map belongs to the thread of the places: `copy` is called there, and `write` in the
    thread of the files, so that a robot that is switched off loses little. `written` is the file, once it was written.
    """

    def __init__(self, config: Config, geometry: Geometry, warn: Callable[[str], None]) -> None:
        """Read the file places.map. One that does not exist is made by this run, unless it only localises.

        warn: takes a line for the user.

        Raises OmnidError for a file that is no map, or that of another rig.
        """
        settings, self._warn, self._rig = config.places, warn, place_rig(geometry)
        if settings.map and not settings.enabled:
            raise OmnidError("places.map (--map) needs places.enabled = true: leave one of them out")
        if settings.localize_only and not settings.map:
            raise OmnidError("places.localize_only (--localize-only) needs a map: add --map FILE.omap, or leave it out")
        # 1. The map: that of the file, a new one, or none. It must fit the rig, and the panoramas of this run.
        path = self._path = Path(settings.map)
        self.is_extended = bool(settings.map) and not settings.localize_only  # the file is written
        self.places = PlaceMap(settings.limits.max_keyframes) if settings.map else None
        if self.is_extended:
            check_outputs([("--map", path)], [])
        if self.is_extended and not path.exists():
            log(logging.INFO, f"a new map begins: {path.name}")
        elif self.places is not None:
            self.places, rig = read_places(path)
            if difference := rig.difference(self._rig):
                raise OmnidError(
                    f"{path}: this map was made with {difference}: build one with this rig, by `omnid map build`"
                )
            if rig.rig_hash != self._rig.rig_hash:
                warn(f"{path}: the rig was calibrated again since this map was made")
            self._rig.adapt(self.places, rig)
        self._loaded_ids = frozenset(self.places.keyframes if self.places else ())
        self.is_new = not self._loaded_ids
        # 2. Saves, and requests for them.
        self.written: Path | None = None
        self._request_ids = deque[int](maxlen=MAX_OPEN)  # since the newest copy
        self._save_ns, self._copied_ns = round(settings.save_s * NS_PER_S), 0
        self._saved = frozenset[int]()  # keyframes in the file
        self._saves, self._error = 0, ""  # number of saves; error of the last one

    def copy(self, message: PlaceUpdate | int) -> MapCopy | None:
        """Take a pose, or the id of a request to save; return a copy of the map after a pose where one is due."""
        if isinstance(message, int):
            self._request_ids.append(message)
            return None
        stamp_ns, ids = message.stamp_ns, tuple(self._request_ids)
        self._copied_ns = self._copied_ns or stamp_ns
        if self.places is None or not (ids or stamp_ns - self._copied_ns >= self._save_ns):
            return None
        self._request_ids.clear()
        self._copied_ns = stamp_ns
        return MapCopy(self.places.part(self.places.keyframes), ids)

    def write(self, copy: MapCopy) -> Answers:
        """Write the joined part of a copy, where it is new; return the answers to its requests."""
        joined = self._joined(copy.places)
        answer, self._error = Answer(True, "the map in the file has all that is known already"), ""
        if joined - self._loaded_ids and joined != self._saved:
            try:
                self._write(copy.places.part(joined))
                self._saved, self._saves, answer = joined, self._saves + 1, Answer(True, "the map is saved")
            except OmnidError as error:
                self._error, answer = str(error), Answer(False, f"the map is not saved: {error}")
        return dict.fromkeys(copy.request_ids, answer)

    def stats(self) -> dict[str, object]:
        """Return how often the map was saved, and why it is not."""
        return {"saves": self._saves, "_error": self._error}

    def finish_run(self) -> None:
        """Write the joined part of the map to its file after the run, if it was extended.

        Raises OmnidError if the file cannot be written.
        """
        if self.places is None:
            return
        joined = self._joined(self.places)
        new, unjoined = len(joined - self._loaded_ids), len(self.places.keyframes.keys() - joined - self._loaded_ids)
        if self._loaded_ids and not new and unjoined:
            self._warn(f"{self._path}: no place of it was recognised: nothing was added to it")
        elif unjoined:
            self._warn(f"{self._path}: {unjoined} keyframes after a gap were recognised nowhere: they were left out")
        if self.is_extended and new:
            self._write(self.places.part(joined))
        elif self.is_extended and not self._loaded_ids:
            self._warn(f"{self._path}: no keyframe was found: no map was written")

    def _write(self, places: PlaceMap) -> None:
        write_places(self._path, places, self._rig)
        self.written = self._path

    def _joined(self, places: PlaceMap) -> frozenset[int]:
        """Return the keyframes that links join to those of the loaded map, or else the largest part."""
        found = places.parts() or [[]]
        return frozenset(next((part for part in found if self._loaded_ids.intersection(part)), found[0]))


def place_rig(geometry: Geometry) -> PlaceRig:
    """Return the part of a rig on which a map depends; its masks may have been found in the images of the run."""
    rig = geometry.rig
    lower, upper = (replace(camera, mask=None) for camera in (rig.lower, rig.upper))
    text = rig_toml(replace(rig, lower=lower, upper=upper, covariance=None))
    digest = hashlib.sha256(text.encode()).hexdigest()
    return PlaceRig(geometry.cylinder.full_turn, rig.baseline_m, geometry.T_rig_rect, rig.T_base_rig, digest)


class RouteFiles:
    """The routes of a run: read at its start, written in the thread of the files once they are taught."""

    def __init__(self, folder: RouteFolder, saves: Stream[int] | None = None) -> None:
        """Read all routes; a damaged file is reported. saves: takes requests to save the map that routes refer to."""
        self._folder, self._saves = folder, saves
        self._written: TaughtRoute | None = None
        self.routes: dict[str, Route] = {}
        for name in folder.names():
            try:
                self.routes[name] = folder.read(name)
            except OmnidError as error:
                log(logging.WARNING, str(error))

    def write(self, update: NavigationUpdate) -> Answers | None:
        """Write the route of an update, if it is a new one; return the answer to the request to finish it."""
        taught = update.taught
        if taught is None or taught is self._written:
            return None
        self._written = taught
        try:
            self._folder.write(taught.route)
        except OmnidError as error:
            return {taught.id: Answer(False, f"{error}; finish it again once that is mended")}
        if self._saves is not None:
            self._saves.push(taught.id)
        return {taught.id: Answer(True, "the route is written")}
