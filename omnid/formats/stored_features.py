"""Features of the keyframes of a map file, read one keyframe at a time while the map is used."""

from __future__ import annotations

import sqlite3
from typing import Final

from drivers.bounded_sqlite import bound_work
from omnid.core.places.place_features import PlaceFeatures
from omnid.core.places.place_rig import PlaceRig
from omnid.formats.place_rows import checksum, read_features
from omnid.formats.place_values import BadRowError

MAX_INSTRUCTIONS: Final = 100_000  # Instructions that SQLite may take for one row; some 20 are needed.


class FeatureFile:
    """An open map file, which is neither locked nor written; if the file is replaced meanwhile, the old one is read."""

    def __init__(self, database: sqlite3.Connection, rig: PlaceRig) -> None:
        """database: it is closed with this object."""
        self._database, self._rig = database, rig

    def __del__(self) -> None:
        self._database.close()

    def read(self, id: int) -> PlaceFeatures | None:
        """Return the features of a keyframe; None where they are missing or damaged."""
        try:
            bound_work(self._database, MAX_INSTRUCTIONS)
            row = self._database.execute("SELECT * FROM features WHERE id = ?", (id,)).fetchone()
            if row is None or checksum(row[:-1]) != row[-1]:
                return None
            return read_features(row[1], row[2], self._rig)
        except (sqlite3.Error, BadRowError, OverflowError, MemoryError):
            return None
