"""Goals, paths and routes: the planner, the state machine of a drive, teach and repeat.

Begin with `navigator.py`: the state machine that takes requests and poses and gives setpoints, with the reason for each
stop. `planner.py` searches a lattice of arcs (hybrid A*) over the floor that is seen, with a cost for floor that is
not, and with people as predicted occupancy (`surroundings.py`). `follower.py` drives along a path; `path.py` and
`route.py` hold the data: positions by arc length, and points tied to keyframes of a map. The planner is a source
of commands like any other: the collision monitor in `control/` limits them.
"""
