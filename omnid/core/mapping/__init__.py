"""The map of a run: points fused in voxels, and the occupancy grid."""
