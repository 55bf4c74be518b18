"""Recognition of places seen before, and the pose in the map that follows from it.

Begin with `localisation.py`: it holds the map and the pose of odom in it, and decides when a place is recognised, when
a loop is closed and when the map gets a new part. `features.py` describes a keyframe, `recognition.py` is the one
search from a shortlist to a verified pose, `place_map.py` bounds and ages the map, `pose_graph.py` and `correction.py`
optimise it. `Relocaliser` uses the same search on the newest keyframes after odometry was lost. Odometry knows
nothing of maps.
"""
