"""Files that other programs read: TUM trajectories, PLY maps, PNG plan views."""
