"""The map of places of a run: read at its start, saved now and then by a daemon, and at the end."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

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
    loses little of it. `written` is the file, once the run has written it.
    """

    def __init__(
        self,
        config: Config,
        geometry: Geometry,
        warn: Callable[[str], None],
        requests: Stream[SaveMap] | None = None,
        answer: Callable[[int, Answer], object] = nothing,
    ) -> None:
        """Read the file places.map. One that does not exist is made by this run, unless it only localises.

        warn: takes a line for the user. requests: of the bus, to save the map, which is then saved each places.save_s
        as well; None: at the end only. answer: takes the id of a request; a second call for it does nothing.

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
            log(logging.INFO, f"{path.name}: there is no such map: this run begins a new one")
        elif self.places is not None:
            self.places, rig = read_places(path, self.places)
            if difference := rig.difference(self._rig):
                raise OmnidError(
                    f"{path}: this map was made with {difference}: build one with this rig, by `omnid map build`"
                )
            if rig.rig_hash != self._rig.rig_hash:
                warn(f"{path}: the rig was calibrated again since this map was made")
            self._rig.adapt(self.places, rig)
        self._known = frozenset(self.places.keyframes if self.places else ())
        # 2. What was saved, and requests for it.
        self.requests = () if requests is None or not self.is_extended else (requests,)
        self.written: Path | None = None
        self._answer = answer
        self._saved = frozenset[int]()  # keyframes in the file
        self._seen: MapCopy | None = None
        self._saves, self._error = 0, ""  # number of saves; what the last one failed by

    def process(self, update: PlaceUpdate) -> None:
        """Write the copy of the map that comes with a pose, if it is a new one."""
        copy = update.copy
        if copy is None or copy is self._seen:
            return
        self._seen, joined = copy, self._joined(copy.places)
        answer, self._error = Answer(True, "the map in the file has all that is known already"), ""
        if joined - self._known and joined != self._saved:
            try:
                self._write(copy.places.part(joined))
                self._saved, self._saves, answer = joined, self._saves + 1, Answer(True, "the map is saved")
            except OmnidError as error:
                self._error, answer = str(error), Answer(False, f"the map is not saved: {error}")
        for id in copy.ids:
            self._answer(id, answer)

    def stats(self) -> dict[str, object]:
        """Return how often the map was saved, and why it is not."""
        return {"saves": self._saves, "_error": self._error, "_words": "saves the map"}

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
        write_places(self._path, places, self._rig)
        self.written = self._path

    def _joined(self, places: PlaceMap) -> frozenset[int]:
        """Return the keyframes that links join to the map that was given, or else the largest part."""
        found = places.parts() or [[]]
        return frozenset(next((part for part in found if self._known.intersection(part)), found[0]))


def place_rig(geometry: Geometry) -> PlaceRig:
    """Return the part of a rig on which a map depends; its masks may have been found in the images of the run."""
    rig = geometry.rig
    lower, upper = (replace(camera, mask=None) for camera in (rig.lower, rig.upper))
    text = rig_toml(replace(rig, lower=lower, upper=upper, covariance=None))
    digest = hashlib.sha256(text.encode()).hexdigest()
    return PlaceRig(geometry.cylinder.full_turn, rig.baseline_m, geometry.T_rig_rect, rig.T_base_rig, digest)
