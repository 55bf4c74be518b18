"""Goals, paths and routes: the planner, the state machine of a drive, teach and repeat.

Begin with `navigator.py`: the state machine that takes requests and poses and gives setpoints, with the reason for each
stop. `planner.py` has what is about the base, and searches a lattice of arcs (hybrid A*) over it. `follower.py` drives
along a path; `path.py` and `route.py` hold what is driven. The planner is a source of commands like any other: the
collision monitor in `control/` comes after it.
"""
