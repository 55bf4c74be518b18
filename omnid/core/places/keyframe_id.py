"""Ids of the keyframes of a map."""

from __future__ import annotations

from typing import Final

NO_KEYFRAME: Final = -1  # Used in place of an id, because ids are never negative.
