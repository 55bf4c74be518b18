"""Map of a run."""

from __future__ import annotations

import numpy as np

from drivers.frame import Frame
from omnid.config import MappingConfig
from omnid.stages.geometry import Geometry
from omnid.stages.mapping import Mapping
from tests.omnid.core.test_frames import odometry
from tests.omnid.stages.scene_parts import depth_of, front_end


def test_maps_certain_points_at_tracked_poses_only(rig_geometry: Geometry, frames: list[Frame]) -> None:
    depth, dense = depth_of(rig_geometry, frames), front_end(rig_geometry).dense
    for state, kept in (("tracking", True), ("degraded", False), ("lost", False)):
        mapping = Mapping(MappingConfig(min_frames=1), dense)
        mapping.process(odometry(np.eye(4), state=state, depth=depth))
        (update,) = mapping.finish()
        assert (len(update.points.xyz) > 0) == kept and len(update.path_xy) == 1
    strict = Mapping(MappingConfig(min_frames=1, max_sigma_m=0.001), dense)
    strict.process(odometry(np.eye(4), depth=depth))
    assert len(strict.finish()[0].points.xyz) == 0
    assert Mapping(MappingConfig(), dense).finish() == []


def test_a_full_map_counts_evicted_voxels(rig_geometry: Geometry, frames: list[Frame]) -> None:
    depth, dense = depth_of(rig_geometry, frames), front_end(rig_geometry).dense
    for log2_voxels, evicts in ((18, False), (10, True)):
        mapping = Mapping(MappingConfig(voxel_m=0.01, log2_voxels=log2_voxels, max_sigma_m=10.0), dense)
        for seq in range(3):
            mapping.process(odometry(np.eye(4), depth=depth, seq=seq))
        assert (mapping.counts["evicted"] > 0) == evicts
        assert 0 < mapping.counts["voxels"] <= 0.7 * 2**log2_voxels + len(dense.of(depth).points)
