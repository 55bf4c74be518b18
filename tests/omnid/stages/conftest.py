"""The rendered scene's frames and geometry."""

from __future__ import annotations

from tests.omnid.stages.scene_parts import frames, rig_geometry

__all__ = ["frames", "rig_geometry"]
