"""File formats for other programs: TUM trajectories, PLY maps, PNG plan views."""
