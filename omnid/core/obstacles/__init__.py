"""Obstacles around the base: a posterior for each ray of a pair, one grid over time, moving obstacles.

Begin with `docs/obstacles.md` for the model, then with `posterior.py`: for each column of a pair it weighs how far the
floor is seen and where the first obstacle begins; the absence of an edge is evidence, too. `grid.py` fuses the rays
over time in cells with the classes unknown, free and occupied, and gives the scan of 360 directions and the
probabilities to planner and collision monitor. `moving_tracker.py` follows what moves. Unknown (dark, dead, hidden,
beyond the view) is never free. Settings are few (`settings.py`); the kernels beside them are compiled loops.
"""
