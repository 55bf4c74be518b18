"""Maps of a run: points fused in voxels, and the occupancy grid of range scans.

Begin with `voxel_map.py`: points of all keyframes are fused by information, in bounded memory (Dang et al. 2012, IV.G).
`range_scan.py` turns the dense depth of a keyframe into the nearest obstacle in each of 360 directions, and
`scan_grid.py` draws these scans into the grid that the bus publishes as `map`; the grid moves with its keyframes when a
loop corrects them. The grid of live obstacles is another one: see `obstacles/`.
"""
